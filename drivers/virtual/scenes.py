"""The three scenes of the paper's section V, rebuilt from plain shapes.

Millimetres; x right, y down, z away from a camera that stands at the origin and looks along z.
The sizes are those of such things: a desk is 750 mm high, an exercise ball 650 mm wide.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from selective_depth.drivers.virtual.renderer import CYLINDER, DISC, QUAD, SPHERE, TORUS, Shapes

Vector = Sequence[float] | npt.NDArray[np.float64]
"""Three numbers."""


class Material(IntEnum):
    """What a surface is made of: its number, `albedo` and `tint`; chosen, not measured.

    Attributes
    ----------
    albedo : float
        Share of the projector's light that returns from it, 0..1.
    tint : (int, int, int)
        Its red, green and blue in full light.
    """

    albedo: float
    tint: tuple[int, int, int]

    NONE = 0, 0.0, (12, 13, 16)
    WALL = 1, 0.85, (214, 206, 190)
    FLOOR = 2, 0.45, (122, 112, 104)
    WOOD = 3, 0.6, (176, 128, 82)
    PLASTIC = 4, 0.45, (92, 96, 104)
    BLACK = 5, 0.14, (38, 38, 42)
    SCREEN = 6, 0.055, (34, 84, 132)
    METAL = 7, 0.3, (158, 164, 170)
    PAINT = 8, 0.6, (186, 52, 44)
    RUBBER = 9, 0.5, (52, 118, 190)
    CLOTH = 10, 0.35, (66, 128, 92)

    def __new__(cls, number: int, albedo: float, tint: tuple[int, int, int]) -> Material:
        """A member that is its number."""
        member = int.__new__(cls, number)
        member._value_, member.albedo, member.tint = number, albedo, tint
        return member


@dataclass(frozen=True)
class Scene:
    """A scene and where to look in it.

    Parameters
    ----------
    shapes : Shapes
    target_mm : float64 array of shape (3,)
        Point that the camera keeps in view.
    sway_mm : float64 array of shape (3,)
        How far the camera wanders from the origin along each axis.
    """

    shapes: Shapes
    target_mm: npt.NDArray[np.float64]
    sway_mm: npt.NDArray[np.float64]


class Builder:
    """Collects shapes. Angles in degrees; yaw turns about y, pitch about the turned x."""

    def __init__(self) -> None:
        self._rows: list[tuple[int, int, Vector, Vector, Vector, tuple[float, float]]] = []

    def _add(
        self,
        kind: int,
        material: Material,
        centre: Vector,
        first: Vector = (0, 0, 1),
        second: Vector = (0, 1, 0),
        size: tuple[float, float] = (0, 0),
    ) -> None:
        self._rows.append((kind, int(material), centre, first, second, size))

    def quad(self, material: Material, centre: Vector, first: Vector, second: Vector, w: float, h: float) -> None:
        """A rectangle `w` by `h` along `first` and `second`, seen from their cross product."""
        self._add(QUAD, material, centre, first, second, (w / 2, h / 2))

    def box(self, material: Material, centre: Vector, size: Vector, yaw: float = 0, pitch: float = 0) -> None:
        """Six quads, each facing outwards."""
        turn = turn_of(yaw, pitch)
        for k in range(3):
            one, two = (k + 1) % 3, (k + 2) % 3
            for sign in (1.0, -1.0):
                middle = np.array(centre) + sign * size[k] / 2 * turn[:, k]
                first, second = turn[:, one], sign * turn[:, two]
                self.quad(material, middle, first, second, size[one], size[two])

    def sphere(self, material: Material, centre: Vector, radius: float) -> None:
        """A ball."""
        self._add(SPHERE, material, centre, size=(radius, 0))

    def rod(self, material: Material, start: Vector, end: Vector, radius: float, ends: str = "flat") -> None:
        """A cylinder with flat, round or open ends."""
        a, b = np.array(start), np.array(end)
        length = float(np.linalg.norm(b - a))
        axis, middle = (b - a) / length, (a + b) / 2
        self._add(CYLINDER, material, middle, axis, size=(radius, length / 2))
        for point in (start, end):
            if ends == "flat":
                self._add(DISC, material, point, axis, size=(radius, 0))
            elif ends == "round":
                self.sphere(material, point, radius)

    def ring(self, material: Material, centre: Vector, axis: Vector, middle: float, tube: float) -> None:
        """A torus."""
        self._add(TORUS, material, centre, np.array(axis) / math.hypot(*axis), size=(middle, tube))

    def chain(self, material: Material, points: list[Vector], radius: float) -> None:
        """A hose: round rods from point to point."""
        self.sphere(material, points[0], radius)
        for start, end in pairwise(points):
            self.rod(material, start, end, radius, ends="open")
            self.sphere(material, end, radius)

    def room(self, floor_y: float, wall_z: float, left_x: float, right_x: float) -> None:
        """Floor, back wall and two side walls, open towards the camera."""
        deep, high = wall_z + 2000, 4000.0
        middle_z, middle_y = wall_z - deep / 2, floor_y - high / 2
        middle_x, wide = (left_x + right_x) / 2, right_x - left_x
        self.quad(Material.FLOOR, (middle_x, floor_y, middle_z), (1, 0, 0), (0, 0, 1), wide, deep)
        self.quad(Material.WALL, (middle_x, middle_y, wall_z), (0, 1, 0), (1, 0, 0), high, wide)
        self.quad(Material.WALL, (left_x, middle_y, middle_z), (0, 1, 0), (0, 0, 1), high, deep)
        self.quad(Material.WALL, (right_x, middle_y, middle_z), (0, 0, 1), (0, 1, 0), deep, high)

    def shapes(self) -> Shapes:
        """All that was added."""
        kind, material, *vectors = zip(*self._rows, strict=True)
        return Shapes(np.array(kind), np.array(material), *(np.array(each, np.float64) for each in vectors))


def turn_of(yaw: float, pitch: float) -> npt.NDArray[np.float64]:
    """Rotation about y by `yaw`, then about the turned x by `pitch`, degrees."""
    a, b = math.radians(yaw), math.radians(pitch)
    about_y = np.array([[math.cos(a), 0, math.sin(a)], [0, 1, 0], [-math.sin(a), 0, math.cos(a)]])
    about_x = np.array([[1, 0, 0], [0, math.cos(b), -math.sin(b)], [0, math.sin(b), math.cos(b)]])
    turn: npt.NDArray[np.float64] = about_y @ about_x
    return turn


def workstation() -> Scene:
    """A desk with two monitors, keyboard and shelf, a chair before it, a tower below."""
    b = Builder()
    floor, desk = 1250.0, 500.0
    b.room(floor, 2600, -1900, 1700)
    # The desk: top, two side panels, a modesty panel, a pedestal with drawers.
    b.box(Material.WOOD, (0, desk + 15, 2150), (1700, 30, 800))
    for x in (-830, 830):
        b.box(Material.WOOD, (x, desk + 390, 2150), (30, 720, 760))
    b.box(Material.WOOD, (0, desk + 230, 2480), (1630, 400, 20))
    for k in range(3):
        b.box(Material.WOOD, (-560, desk + 150 + 215 * k, 2120), (400, 205, 640))
        b.rod(Material.METAL, (-630, desk + 150 + 215 * k, 1785), (-490, desk + 150 + 215 * k, 1785), 8)
    b.box(Material.BLACK, (520, floor - 220, 2200), (190, 440, 460))
    # Two monitors, turned towards the user, screens set back in their frames.
    for x, yaw in ((-330, 14), (300, -16)):
        turn = turn_of(yaw, 0)
        foot = np.array((x, desk, 2270.0))
        b.box(Material.PLASTIC, (x, desk - 8, 2270), (240, 16, 190), yaw)
        b.box(Material.PLASTIC, foot + turn @ (0, -110, 40), (70, 200, 30), yaw)
        middle = foot + turn @ (0, -290, 0)
        b.box(Material.PLASTIC, middle, (540, 345, 40), yaw)
        screen = middle + turn @ (0, 0, -20.5)
        b.quad(Material.SCREEN, screen, turn[:, 1], turn[:, 0], 300, 500)
    # On the desk.
    b.box(Material.BLACK, (-60, desk - 12, 1900), (450, 24, 150), 4, 4)
    b.rod(Material.PLASTIC, (290, desk - 18, 1900), (300, desk - 18, 1945), 19, "round")
    b.rod(Material.PAINT, (520, desk, 1960), (520, desk - 95, 1960), 42)
    b.ring(Material.PAINT, (568, desk - 48, 1960), (0, 0, 1), 26, 6)
    b.box(Material.WALL, (-640, desk - 20, 1960), (215, 40, 300), -12)
    b.rod(Material.METAL, (690, desk - 8, 2250), (690, desk - 380, 2250), 9)
    b.rod(Material.METAL, (690, desk - 380, 2250), (560, desk - 520, 2120), 9, "round")
    b.sphere(Material.PAINT, (545, desk - 515, 2105), 62)
    b.rod(Material.METAL, (690, desk, 2250), (690, desk - 16, 2250), 85)
    # A shelf with books on the wall.
    b.box(Material.WOOD, (-150, -220, 2480), (1300, 25, 240))
    at = -760.0
    for k in range(17):
        wide, high = 22 + 9 * (k * 5 % 4), 190 + 18 * (k * 7 % 5)
        slant = 0 if k % 6 else 5
        b.box(Material.CLOTH, (at + wide / 2, -232 - high / 2, 2490 + slant), (wide, high, 170))
        at += wide + (3 if k % 5 else 45)
    b.box(Material.PAINT, (330, -330, 2490), (300, 190, 200), 10)
    # An office chair, turned a little.
    turn = turn_of(-28, 0)
    chair = np.array((430, floor, 1520.0))

    def on_chair(x: float, y: float, z: float) -> Vector:
        return chair + turn @ (x, -y, z)

    b.box(Material.CLOTH, on_chair(0, 470, 0), (470, 80, 450), -28)
    b.box(Material.CLOTH, on_chair(0, 800, -235), (440, 480, 60), -28, -8)
    b.rod(Material.METAL, on_chair(0, 80, 0), on_chair(0, 430, 0), 28)
    b.rod(Material.BLACK, on_chair(0, 450, -200), on_chair(0, 720, -255), 22, "round")
    for side in (-1, 1):
        b.rod(Material.BLACK, on_chair(side * 255, 470, 0), on_chair(side * 255, 650, 0), 18)
        b.box(Material.BLACK, on_chair(side * 255, 665, 0), (60, 30, 260), -28)
    for k in range(5):
        angle = 2 * math.pi * k / 5 + 0.3
        tip = (290 * math.cos(angle), 60, 290 * math.sin(angle))
        b.rod(Material.BLACK, on_chair(0, 95, 0), on_chair(*tip), 20, "round")
        b.sphere(Material.BLACK, on_chair(tip[0], 28, tip[2]), 28)
    return Scene(b.shapes(), np.array((0, 310, 2050.0)), np.array((330, 130, 200.0)))


def exercise_ball() -> Scene:
    """A large exercise ball on a mat before a wall with a door and a radiator."""
    b = Builder()
    floor = 1150.0
    b.room(floor, 2550, -2100, 2000)
    b.box(Material.WALL, (-50, floor - 45, 2542), (4100, 90, 16))
    b.box(Material.RUBBER, (60, floor - 6, 1750), (1700, 12, 800), 8)
    b.sphere(Material.RUBBER, (0, floor - 12 - 325, 1750), 325)
    b.rod(Material.BLACK, (0, floor - 12 - 325, 1422), (0, floor - 12 - 325, 1460), 11)
    for x, z, yaw in ((-560, 1500, 35), (520, 1420, -60)):
        turn = turn_of(yaw, 0)
        grip = np.array((x, floor - 62, float(z)))
        b.rod(Material.METAL, grip - turn[:, 0] * 75, grip + turn[:, 0] * 75, 15)
        for sign in (-1, 1):
            inner, outer = grip + sign * turn[:, 0] * 70, grip + sign * turn[:, 0] * 135
            b.rod(Material.RUBBER, inner, outer, 52)
    # The door in its frame.
    b.box(Material.WOOD, (-1050, floor - 1000, 2535), (800, 2000, 20))
    for x in (-1490, -610):
        b.box(Material.PAINT, (x, floor - 1040, 2530), (80, 2080, 50))
    b.sphere(Material.METAL, (-700, floor - 1000, 2485), 28)
    # The radiator.
    for k in range(14):
        x = 560 + 62 * k
        b.rod(Material.PAINT, (x, floor - 120, 2460), (x, floor - 640, 2460), 24, "round")
    for y in (floor - 140, floor - 620):
        b.rod(Material.PAINT, (540, y, 2472), (1400, y, 2472), 20)
    return Scene(b.shapes(), np.array((40, 640, 1750.0)), np.array((380, 160, 200.0)))


def fire_hose() -> Scene:
    """A fire-hose station: cabinet with a reel, valves and pipes before a flat wall."""
    b = Builder()
    floor, wall = 1100.0, 2100.0
    # The flat wall ends at a corridor, whose far end is the widest depth.
    b.quad(Material.FLOOR, (0, floor, 3000), (1, 0, 0), (0, 0, 1), 6000, 8000)
    b.quad(Material.WALL, (-950, -900, wall), (0, 1, 0), (1, 0, 0), 4000, 4000)
    b.quad(Material.WALL, (1050, -900, wall + 1700), (0, 1, 0), (0, 0, 1), 4000, 3400)
    b.quad(Material.WALL, (2300, -900, 4200), (0, 0, 1), (0, 1, 0), 6000, 4000)
    b.quad(Material.WALL, (1600, -900, 5700), (0, 1, 0), (1, 0, 0), 4000, 3000)
    # The cabinet: a shallow open box.
    left, right, top, bottom = -330.0, 430.0, -330.0, 480.0
    for y in (top, bottom):
        b.box(Material.PAINT, ((left + right) / 2, y, wall - 110), (right - left + 24, 24, 220))
    for x in (left, right):
        b.box(Material.PAINT, (x, (top + bottom) / 2, wall - 110), (24, bottom - top, 220))
    # The reel with its hose, the hub and the nozzle.
    hub = (50.0, 40.0, wall - 130)
    for ring, middle in enumerate((160, 218, 276)):
        b.ring(Material.CLOTH, (hub[0], hub[1], hub[2] - 8 * (ring % 2)), (0, 0, 1), middle, 29)
    b.rod(Material.PAINT, hub, (hub[0], hub[1], hub[2] - 60), 105)
    b.rod(Material.METAL, (hub[0], hub[1], hub[2] - 60), (hub[0], hub[1], hub[2] - 95), 34)
    z = hub[2]
    hose: list[Vector] = [(326, 40, z), (334, 200, z - 25), (300, 330, z - 60), (230, 400, z - 75), (140, 405, z - 80)]
    b.chain(Material.CLOTH, hose, 29)
    b.rod(Material.METAL, (140, 405, hub[2] - 80), (20, 395, hub[2] - 85), 16)
    b.rod(Material.METAL, (20, 395, hub[2] - 85), (-60, 388, hub[2] - 88), 25)
    # The riser with its flanges and the valve wheel.
    b.rod(Material.PAINT, (-760, -3000, wall - 160), (-760, floor, wall - 160), 84, "open")
    for y in (-640.0, 130.0, 820.0):
        b.rod(Material.PAINT, (-760, y - 22, wall - 160), (-760, y + 22, wall - 160), 128)
    b.rod(Material.PAINT, (-760, 330, wall - 160), (left, 330, wall - 130), 40)
    b.rod(Material.PAINT, (-590, 330, wall - 148), (-550, 330, wall - 146), 66)
    wheel = (-500.0, 330.0, wall - 290)
    b.rod(Material.METAL, (wheel[0], wheel[1], wall - 140), wheel, 14)
    b.ring(Material.PAINT, wheel, (0.1, 0.1, 1), 88, 11)
    for k in range(3):
        angle = math.radians(20 + 60 * k)
        dx, dy = 86 * math.cos(angle), 86 * math.sin(angle)
        start = (wheel[0] - dx, wheel[1] - dy, wheel[2])
        b.rod(Material.PAINT, start, (wheel[0] + dx, wheel[1] + dy, wheel[2]), 8)
    # Thinner pipes along and across the wall.
    b.rod(Material.METAL, (-1060, -3000, wall - 70), (-1060, floor, wall - 70), 45, "open")
    b.rod(Material.METAL, (-1230, -3000, wall - 60), (-1230, floor, wall - 60), 30, "open")
    b.rod(Material.PAINT, (-3000, -560, wall - 300), (1050, -560, wall - 300), 48, "flat")
    b.rod(Material.METAL, (-3000, -690, wall - 90), (1000, -690, wall - 90), 27, "flat")
    for x in (-420.0, 620.0):
        b.rod(Material.PAINT, (x, -560, wall - 300), (x, -560, wall), 20, "open")
        b.rod(Material.PAINT, (x - 15, -560, wall - 300), (x + 15, -560, wall - 300), 66)
    b.rod(Material.PAINT, (800, -560, wall - 300), (800, 260, wall - 300), 34, "round")
    b.rod(Material.PAINT, (800, 260, wall - 300), (800, 260, wall), 34, "round")
    b.rod(Material.METAL, (800, -200, wall - 330), (800, -200, wall - 395), 58)
    # An extinguisher in front, and a rail nearer to the camera.
    b.rod(Material.PAINT, (700, floor - 90, 1800), (700, floor - 480, 1800), 82, "round")
    b.rod(Material.BLACK, (700, floor - 560, 1800), (700, floor - 640, 1800), 26)
    b.chain(Material.BLACK, [(720, floor - 610, 1790), (800, floor - 560, 1770), (815, floor - 380, 1770)], 13)
    b.rod(Material.METAL, (-900, 560, 1320), (-420, 585, 1290), 24, "round")
    for x, z in ((-840.0, 1316.0), (-470.0, 1293.0)):
        b.rod(Material.METAL, (x, 570, z), (x, floor, z), 20, "open")
    return Scene(b.shapes(), np.array((40, 90, 2000.0)), np.array((340, 150, 200.0)))


SCENES: dict[str, Callable[[], Scene]] = {"workstation": workstation, "ball": exercise_ball, "firehose": fire_hose}
"""The scenes by name."""

ALIASES = {"exercise-ball": "ball", "fire-hose": "firehose"}
"""Other names of the same scenes."""
