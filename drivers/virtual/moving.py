"""Things that move through a virtual scene, in the axes of the camera as it stands at first.

What a memory of a scene must notice: something that crosses the view, something large that walks,
something that stops, and a thing that is turned and stays so.
"""

from __future__ import annotations

from collections.abc import Callable

from selective_depth.drivers.virtual.renderer import Shapes
from selective_depth.drivers.virtual.scenes import Builder, Material, turn_of

OUTSIDE_MM = 1300.0
"""So far to the side, what is 2 m away is not seen by a Kinect."""

BALL_MM_S, BALL_MM = 1400.0, 150.0
PERSON_MM_S = 1000.0
TURNED_S = 2.0
STOPPED_S = 0.9


def ball(b: Builder, time_s: float) -> None:
    """A ball of 150 mm radius crosses from the left at 1.4 m/s, 1.6 m away."""
    b.sphere(Material.RUBBER, (BALL_MM_S * time_s - OUTSIDE_MM, -120.0, 1600.0), BALL_MM)


def second_ball(b: Builder, time_s: float) -> None:
    """Another ball of that size crosses lower, from the right, 1.9 m away."""
    b.sphere(Material.RUBBER, (OUTSIDE_MM - BALL_MM_S * time_s, 350.0, 1900.0), BALL_MM)


def stopping_ball(b: Builder, time_s: float) -> None:
    """The same ball stops in mid-view after 0.9 s."""
    ball(b, min(time_s, STOPPED_S))


def person(b: Builder, time_s: float) -> None:
    """A box of a person's size walks from the right at 1 m/s, 1.9 m away."""
    b.box(Material.CLOTH, (1.2 * OUTSIDE_MM - PERSON_MM_S * time_s, 250.0, 1900.0), (450, 1700, 300))


def chair(b: Builder, time_s: float) -> None:
    """A chair 1.5 m away that somebody turns after two seconds, within a fifth of one."""
    yaw = 15 + 70 * min(max(time_s - TURNED_S, 0.0) / 0.2, 1.0)
    b.box(Material.CLOTH, (-250.0, 330.0, 1500.0), (420, 70, 420), yaw)
    back = turn_of(yaw, 0) @ (0, 0, 180) + (-250.0, 100.0, 1500.0)
    b.box(Material.CLOTH, back, (420, 400, 60), yaw)
    b.rod(Material.METAL, (-250.0, 365.0, 1500.0), (-250.0, 700.0, 1500.0), 30)


_MOVING = (ball, second_ball, stopping_ball, person, chair)
MOVING: dict[str, Callable[[Builder, float], None]] = {each.__name__.replace("_", "-"): each for each in _MOVING}
"""What can move, by name; each adds itself as it stands at a time."""


def moving_shapes(names: tuple[str, ...], time_s: float) -> Shapes:
    """The shapes of what moves, `time_s` seconds after the first frame, in the camera's axes."""
    b = Builder()
    for name in names:
        MOVING[name](b, time_s)
    return b.shapes()
