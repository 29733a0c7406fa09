"""A virtual Kinect: the paper's three scenes, seen by a camera held in a hand."""

from __future__ import annotations

import math
import time

import numpy as np
import numpy.typing as npt

from selective_depth.drivers.colour import Colouring
from selective_depth.drivers.errors import SourceEndedError, SourceNotFoundError, SourceTimeoutError
from selective_depth.drivers.frame import Camera, ColourArray, DepthArray, DepthFrame, handed_over, millimetres
from selective_depth.drivers.options import Options
from selective_depth.drivers.source import DepthSource
from selective_depth.drivers.virtual.moving import MOVING, moving_shapes
from selective_depth.drivers.virtual.noise import kinect_depth
from selective_depth.drivers.virtual.paint import paint
from selective_depth.drivers.virtual.renderer import cast
from selective_depth.drivers.virtual.scenes import ALIASES, SCENES, Material, Scene

FPS = 30.0

_ALBEDO = np.array([stuff.albedo for stuff in Material], np.float32)

# A hand's path: wide and slow, narrow and faster, tremor. Hertz, share of the scene's sway.
_HAND = ((0.071, 0.75), (0.19, 0.25), (1.3, 0.008))
_GAZE_MM = 130.0  # how far the gaze wanders round the scene's target
_ROLL_RAD = 0.03


class VirtualSource(DepthSource):
    """Depth frames of a made scene, with or without a Kinect's errors.

    Frame `k` is a pure function of scene, seed, speed, size and `k`.

    Parameters
    ----------
    name : str
        ``workstation``, ``ball`` or ``firehose``; options after ``?``, with ``&`` between:
        ``noise=kinect``, ``kinect+fixed`` (half of the error stays in place from frame to frame) or
        ``off`` (the exact depth, rounded to a millimetre);
        ``frames=120``, how many there are (live: no end unless given);
        ``seed=1``, of the camera's path and the sensor's error;
        ``speed=1``, of the camera, 0 = it stands still;
        ``moving=ball``, or more of `MOVING` with ``+`` between: what else moves;
        ``cut=ball@20``, to another scene, from that frame on;
        ``size=640x480``, the field of view's width stays that of a Kinect;
        ``colour=off``: no colour image; otherwise there is one, registered to depth;
        ``live=0`` or ``1``: paced at 30 frames a second like a device, the newest frame wins.

    Raises
    ------
    SourceNotFoundError
        If there is no such scene or option, naming those there are.
    """

    def __init__(self, name: str) -> None:
        asked, _, text = name.partition("?")
        scene = ALIASES.get(asked, asked)
        if scene not in SCENES:
            raise SourceNotFoundError(
                f"there is no virtual scene '{asked}'; give virtual: and one of {', '.join(SCENES)}"
            )
        options = Options(text, f"virtual:{asked}")
        self._noise = options.choice("noise", "kinect", ("kinect", "kinect+fixed", "off"))
        frames = options.integer("frames", 0, 0, 10_000_000)
        self.seed = options.integer("seed", 1, 0, 2**32 - 1)
        self._speed = options.number("speed", 1.0, 0.0, 100.0)
        self._moving = options.choices("moving", tuple(MOVING))
        self._cut = options.change("cut", tuple(SCENES))
        width, height = options.size("size", (640, 480))
        self.live = options.choice("live", "0", ("0", "1")) == "1"
        self._colouring = Colouring.of(options)
        options.done()
        self.frame_count = frames or (None if self.live else 120)
        self.uri = f"virtual:{name}"
        self.camera = Camera.kinect(width, height)
        self.fps = FPS
        self._scene = SCENES[scene]()
        self._next = 0
        self._start_s: float | None = None
        self._closed = False

    def read(self, timeout_s: float = 5.0) -> DepthFrame:
        """Return the next frame; a live source waits for it and leaves out what is too late.

        Raises
        ------
        SourceEndedError
            After the last frame, and after `close`.
        SourceTimeoutError
            If a live source's next frame is not due within `timeout_s`.
        """
        if self.live and not self._closed:
            self._wait(timeout_s)
        if self._closed or (self.frame_count is not None and self._next >= self.frame_count):
            raise SourceEndedError(f"all frames of {self.uri} are delivered")
        index = self._next
        self._next += 1
        depth_mm, truth_mm, colour = self._render(index, noise=self._noise != "off", coloured=self._colouring.wanted)
        time_us = round(index * 1e6 / FPS)
        frame = DepthFrame(depth_mm, index, time_us, self.camera, self.uri, truth_mm=truth_mm)
        if colour is not None:
            frame = self._colouring.colour(frame, colour, time_us, True)
        if self.live and self.tap is not None:
            self.tap(frame)
        return frame

    def _render(
        self, index: int, *, noise: bool, coloured: bool = False
    ) -> tuple[DepthArray, DepthArray, ColourArray | None]:
        """Depth as asked for, the exact one, and colour if it is wanted."""
        scene = self._scene
        if self._cut is not None and index >= self._cut[1]:
            scene = SCENES[self._cut[0]]()
        shapes = scene.shapes
        if self._moving:
            rotation, position_mm = camera_pose(scene, 0.0, self.seed)
            moving = moving_shapes(self._moving, index / FPS)
            # From the first camera's axes to the scene's: a turn is undone by its transpose.
            shapes = shapes.beside(moving.seen_from(rotation.T, -rotation @ position_mm))
        rotation, position_mm = camera_pose(scene, index / FPS * self._speed, self.seed)
        nearness, material = cast(shapes.seen_from(rotation, position_mm), self.camera)
        with np.errstate(divide="ignore"):
            exact = handed_over(millimetres(1.0 / nearness, 1000.0))
        colour = paint(nearness, material, self.camera, rotation, position_mm) if coloured else None
        if not noise:
            return exact, exact, colour
        frame_seed = (self.seed << 32) + index + 1
        fixed_seed = (self.seed << 32) if self._noise == "kinect+fixed" else None
        seen = kinect_depth(nearness, material, _ALBEDO, self.camera, frame_seed, fixed_seed)
        return seen, exact, colour

    def skip(self, frames: int) -> None:
        """Leave out frames, none of which depends on another."""
        self._next += frames

    def close(self) -> None:
        """No frame follows."""
        self._closed = True

    def _wait(self, timeout_s: float) -> None:
        """Sleep until a frame is due; skip those whose successor is due already."""
        now = time.monotonic()
        if self._start_s is None:
            self._start_s = now
        due = self._start_s + self._next / FPS
        if due - now > timeout_s:
            raise SourceTimeoutError(
                f"the next frame of {self.uri} is due in {due - now:.3f} s, later than the"
                f" {timeout_s:g} s given; wait longer"
            )
        time.sleep(max(due - now, 0.0))
        newest = int((time.monotonic() - self._start_s) * FPS)
        if self.frame_count is not None:
            newest = min(newest, self.frame_count - 1)
        self.dropped += max(newest - self._next, 0)
        self._next = max(newest, self._next)


def camera_pose(scene: Scene, time_s: float, seed: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Where a hand holds the camera: an endless smooth path round the scene's target.

    Parameters
    ----------
    scene : Scene
    time_s : float
        Seconds since the first frame.
    seed : int
        Of the path's phases.

    Returns
    -------
    rotation : float64 array of shape (3, 3)
        Rows: the camera's right, down and forward in the scene's axes.
    position_mm : float64 array of shape (3,)
    """
    phases = np.random.default_rng(seed).uniform(0, 2 * math.pi, (7, len(_HAND)))
    # No two axes keep step: each has its own small change of tempo.
    tempo = 1 + 0.13 * np.arange(7)[:, None] / 7
    angles = 2 * math.pi * np.array([hertz for hertz, _ in _HAND]) * tempo * time_s + phases
    wander = (np.sin(angles) * np.array([share for _, share in _HAND])).sum(axis=1)
    position_mm = scene.sway_mm * wander[:3]
    forward = scene.target_mm + _GAZE_MM * wander[3:6] - position_mm
    forward /= np.linalg.norm(forward)
    roll = _ROLL_RAD * float(wander[6])
    right = np.cross((math.sin(roll), math.cos(roll), 0.0), forward)
    right /= np.linalg.norm(right)
    return np.stack((right, np.cross(forward, right), forward)), position_mm
