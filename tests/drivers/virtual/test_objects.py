"""Objects from PLY files: the reader, the rendering, the source."""

from __future__ import annotations

import contextlib
import math
import struct
import time
import tracemalloc
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from selective_depth.drivers.errors import DamagedRecordingError, SourceEndedError, SourceError, SourceNotFoundError
from selective_depth.drivers.frame import Camera
from selective_depth.drivers.open import open_source
from selective_depth.drivers.virtual.objects import OBJECT_MM, SIDES, MeshSource, place, render
from selective_depth.drivers.virtual.ply import Mesh, read_ply
from selective_depth.selectors.seeds import SeedGrid

FORMATS = ("ascii", "binary_little_endian", "binary_big_endian")


def ply_bytes(points, faces=(), form="ascii", scalar="double", extra=False) -> bytes:
    """A PLY file, written value by value."""
    lines = ["ply", f"format {form} 1.0", "comment by the tests", f"element vertex {len(points)}"]
    lines += [f"property {scalar} {axis}" for axis in "xyz"]
    if extra:
        lines += ["property uchar red", "element edge 1", "property int a", "property int b"]
    if len(faces):
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        lines += ["property short label"] if extra else []
    header = ("\n".join([*lines, "end_header"]) + "\n").encode()
    rows: list[list[tuple[str, float]]] = []
    code = "d" if scalar == "double" else "f"
    for point in points:
        rows.append([(code, float(value)) for value in point] + ([("B", 7)] if extra else []))
    if extra:
        rows.append([("i", 0), ("i", -1)])
    for face in faces:
        rows.append([("B", len(face)), *(("i", int(corner)) for corner in face)])
        rows[-1] += [("h", -3)] if extra else []
    if form == "ascii":
        texts = (" ".join(repr(value) for _, value in row) for row in rows)
        return header + ("\n".join(texts) + "\n").encode()
    order = "<" if form == "binary_little_endian" else ">"
    return header + b"".join(struct.pack(order + kind, value) for row in rows for kind, value in row)


def fans(faces) -> list[tuple[int, int, int]]:
    return [(face[0], face[k], face[k + 1]) for face in faces for k in range(1, len(face) - 1)]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "object.ply"


POINTS = arrays.arrays(np.float64, st.tuples(st.integers(1, 12), st.just(3)), elements=st.floats(-1e6, 1e6, width=32))


@settings(max_examples=150, deadline=None)
@given(
    points=POINTS,
    form=st.sampled_from(FORMATS),
    scalar=st.sampled_from(["float", "double"]),
    extra=st.booleans(),
    data=st.data(),
)
def test_what_was_written_is_read(tmp_path_factory, points, form, scalar, extra, data):
    corner = st.integers(0, len(points) - 1)
    faces = data.draw(st.lists(st.lists(corner, min_size=0, max_size=6), max_size=8))
    path = tmp_path_factory.getbasetemp() / "round.ply"
    path.write_bytes(ply_bytes(points, faces, form, scalar, extra))
    mesh = read_ply(path)
    assert np.array_equal(mesh.points, points)
    assert mesh.triangles.dtype == np.int32
    assert mesh.triangles.tolist() == [list(triangle) for triangle in fans(faces)]


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("faces", [[(0, 1, 2), (1, 2, 3)], [(0, 1, 2, 3), (1, 2, 3)], []])
def test_a_file_cut_anywhere_is_refused_by_name(file, form, faces):
    points = np.array([[0, 0, 0], [1, 0, 0.5], [0, 1, 0.25], [1, 1, 0]], float)
    whole = ply_bytes(points, faces, form)
    for end in range(len(whole) - 1):
        file.write_bytes(whole[:end])
        # An ascii file that lost only digits of its last number is still a file.
        with contextlib.suppress(SourceError):
            mesh = read_ply(file)
            assert form == "ascii"
            assert end > len(whole) - 5
            assert len(mesh.points) == 4
    file.write_bytes(whole)
    assert len(read_ply(file).triangles) == len(fans(faces))


@settings(max_examples=300, deadline=None)
@given(
    form=st.sampled_from(FORMATS),
    hits=st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 255)), min_size=1, max_size=6),
)
def test_a_damaged_file_is_read_or_refused_by_name(tmp_path_factory, form, hits):
    points = np.array([[0, 0, 0], [1, 0, 0.5], [0, 1, 0.25], [1, 1, 0]], float)
    data = bytearray(ply_bytes(points, [(0, 1, 2, 3), (1, 2, 3)], form))
    for place_, value in hits:
        data[place_ % len(data)] = value
    path = tmp_path_factory.getbasetemp() / "damaged.ply"
    path.write_bytes(bytes(data))
    try:
        mesh = read_ply(path)
    except SourceError as error:
        assert len(str(error)) > 30
        return
    assert np.isfinite(mesh.points).all()
    assert mesh.triangles.size == 0 or mesh.triangles.max() < len(mesh.points)


HEADER = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "is not a PLY file"),
        ("plynth\n", "is not a PLY file"),
        ("ply\nformat ascii 1.0\n", "header has no end"),
        ("ply\nend_header\n1 2 3\n", "names no format"),
        ("ply\nformat morse 1.0\nend_header\n", "format morse"),
        (HEADER + "end_header\n1 2\n", "property 'z'"),
        (HEADER + "property float z\nend_header\n1 2\n", "ends within its 1 rows of 'vertex'"),
        (HEADER + "property float z\nend_header\n1 2 nan\n", "not finite"),
        (HEADER + "property float z\nend_header\n1 2 1e300\n", "beyond 1e"),
        (HEADER + "property float z\nend_header\n1 2 three\n", "something other than numbers"),
        (HEADER + "property string z\nend_header\n1 2 3\n", "property string z"),
        (HEADER.replace("1\np", "99999999999\np") + "end_header\n1 2\n", "ends within its 99999999999 rows"),
        (
            HEADER + "property float z\nelement face 1\nproperty list uchar int vertex_indices\n"
            "end_header\n1 2 3\n3 0 1 0\n",
            "names vertex 1",
        ),
        (
            HEADER + "property float z\nelement face 1\nproperty list uchar int vertex_indices\n"
            "end_header\n1 2 3\n-3 0 0 0\n",
            "list of -3 items",
        ),
        (
            HEADER + "property float z\nelement face 1\nproperty list uchar int vertex_indices\n"
            "end_header\n1 2 3\n3 0 0.7 0\n",
            r"names vertex 0\.7; there are 1 vertices",
        ),
        (HEADER + "element vertex 1\nproperty float z\nend_header\n1 2 3\n", "two elements"),
    ],
)
def test_what_is_wrong_is_told(file, text, says):
    file.write_text(text)
    with pytest.raises((SourceNotFoundError, DamagedRecordingError), match=says) as caught:
        open_source(file)
    assert str(file) in str(caught.value)


@pytest.mark.parametrize("items", [2**28, 2**31 - 1, 2**31, 2**32 - 1])
@pytest.mark.parametrize("scalar", ["uchar", "double"])
def test_a_list_that_claims_more_than_the_file_holds_is_refused_at_once(file, items, scalar):
    head = ply_bytes([(0, 0, 0)], [(0, 0, 0)], "binary_little_endian").partition(b"end_header")[0]
    head = head.replace(b"list uchar int", f"list uint {scalar}".encode())
    rows = struct.pack("<3d", 0, 0, 0) + struct.pack("<I", items) + bytes(300)
    file.write_bytes(head + b"end_header\n" + rows)
    tracemalloc.start()
    with pytest.raises(DamagedRecordingError, match=r"ends within its 1 rows|a list of"):
        read_ply(file)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100_000


def test_short_faces_of_all_lengths_do_not_take_long(file):
    """3 MB of polygons of no, one and three corners: the worst that a mixed file can be."""
    corners = np.arange(12.0).reshape(4, 3)
    head = ply_bytes(corners, [()], "binary_big_endian").replace(b"uchar int", b"uchar uchar")
    rows = 430_000
    head = head[:-1].replace(b"element face 1", b"element face %d" % (3 * rows))
    file.write_bytes(head + bytes([0, 1, 3, 3, 0, 1, 2]) * rows)
    start = time.process_time()
    mesh = read_ply(file)
    assert time.process_time() - start < 10
    assert mesh.triangles.shape == (rows, 3)
    assert (mesh.triangles == (0, 1, 2)).all()


@pytest.mark.parametrize("count", [200, pytest.param(2000, marks=pytest.mark.slow)])
def test_headers_and_counts_that_lie_are_read_or_refused(file, count):
    rng = np.random.default_rng(count)
    points = np.array([[0, 0, 0], [1, 0, 0.5], [0, 1, 0.25], [1, 1, 0]], float)
    kinds = ["char", "uchar", "short", "ushort", "int", "uint", "float", "double"]
    numbers = ["0", "1", "3", "5", "-1", "1.5", "255", "65536", "2147483647", "4294967295", "1e9"]
    read = 0
    for number in range(count):
        whole = ply_bytes(points, [(0, 1, 2, 3), (1, 2, 3)], FORMATS[number % 3], extra=True)
        head, end, body = whole.partition(b"end_header\n")
        words = head.decode().split(" ")
        for _ in range(rng.integers(1, 4)):
            at = rng.integers(len(words))
            old, line, more = words[at].partition("\n")
            pool = numbers if old.isdecimal() else kinds if old in kinds else kinds + numbers
            words[at] = str(rng.choice(pool)) + line + more
        data = bytearray(body)
        for at in rng.integers(len(data), size=rng.integers(3)):
            data[at] = rng.choice([0, 1, 48, 57, 127, 128, 255])
        file.write_bytes(" ".join(words).encode() + end + data)
        try:
            mesh = read_ply(file)
        except SourceError as error:
            assert len(str(error)) < 500
            continue
        read += 1
        assert np.isfinite(mesh.points).all()
        assert mesh.triangles.size == 0 or mesh.triangles.max() < len(mesh.points)
    assert 0 < read < count


def test_windows_line_ends_are_read(file):
    file.write_bytes(ply_bytes([(1, 2, 3)]).replace(b"\n", b"\r\n"))
    assert read_ply(file).points.tolist() == [[1, 2, 3]]


# Rendering.


def slow_render(points, triangles, camera) -> npt.NDArray[np.float64]:
    """Every ray against every triangle (Moeller and Trumbore's equations); 0 = nothing."""
    depth = np.full((camera.height, camera.width), np.inf)
    for row in range(camera.height):
        for column in range(camera.width):
            ray = np.array([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, 1.0])
            for a, b, c in points[triangles]:
                system = np.stack((ray, a - b, a - c), axis=1)
                if abs(np.linalg.det(system)) < 1e-9:
                    continue
                z, wb, wc = np.linalg.solve(system, a)
                if wb >= 0 and wc >= 0 and wb + wc <= 1 and 0 < z < depth[row, column]:
                    depth[row, column] = z
    return np.where(np.isfinite(depth), depth, 0)


@settings(max_examples=25, deadline=None)
@given(
    points=arrays.arrays(np.float64, (6, 3), elements=st.floats(-1, 1, allow_nan=False, allow_subnormal=False)),
    triangles=arrays.arrays(np.int32, (4, 3), elements=st.integers(0, 5)),
    side=st.sampled_from(sorted(SIDES)),
)
def test_triangles_are_where_their_rays_are(points, triangles, side):
    camera = Camera(24, 18, 20.3, 21.7, 11.6, 8.9)
    placed, triangles = place(Mesh(points, triangles), side, camera)
    fast = render(placed, triangles, camera)
    slow = slow_render(placed, triangles, camera)
    differs = np.abs(fast - slow) > 0.501
    # Only where a ray passes within rounding of an edge may one see it and the other not.
    assert differs.sum() <= 2
    again = slow_render(placed * [1 + 1e-7, 1 - 1e-7, 1], triangles, camera)
    assert not (differs & (np.abs(slow - again) < 0.01) & (slow > 0) & (fast > 0)).any()


def cube(size: float = 1.0, at=(0.0, 0.0, 0.0)) -> tuple[npt.NDArray[np.float64], list]:
    corners = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return corners * size + at, quads


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e9])
@pytest.mark.parametrize("side", SIDES)
def test_a_cube_of_any_unit_fills_the_frame_from_any_side(file, side, scale):
    points, faces = cube(scale, at=(40 * scale, -7 * scale, 3 * scale))
    file.write_bytes(ply_bytes(points, faces, "binary_big_endian"))
    with open_source(f"{file}?side={side}&fit=frame") as source:
        frame = source.read()
    assert frame.shape == (480, 640)
    seen = frame.depth_mm > 0
    rows, columns = np.flatnonzero(seen.any(1)), np.flatnonzero(seen.any(0))
    assert np.ptp(rows) == pytest.approx(480 * 0.96, abs=2)
    assert np.ptp(columns) == pytest.approx(480 * 0.96, abs=2)
    near = frame.depth_mm[seen]
    assert (near == near[0]).all()  # one face, seen squarely
    assert near[0] == pytest.approx(OBJECT_MM * 585 / (480 * 0.96), abs=1)


def test_each_side_is_the_named_one(file):
    # A flag that reaches towards +x at the top, on a plate at z = 0, nearest at its front.
    plate = np.array([(0, 0, 0), (4, 0, 0), (4, 3, 0), (0, 3, 0)], float)
    flag = np.array([(3, 2, 1), (4, 2, 1), (4, 3, 1), (3, 3, 1)], float)
    file.write_bytes(ply_bytes(np.concatenate((plate, flag)), [(0, 1, 2, 3), (4, 5, 6, 7)]))
    front = MeshSource(f"{file}?side=front&focal=9000").read().depth_mm
    assert front[20, -20] < front[-20, 20]
    assert front[20, 20] == front[-20, 20] == front[-20, -20]
    back = MeshSource(f"{file}?side=back&focal=9000").read().depth_mm
    assert (back == back[back > 0].min()).mean() > 0.85  # the plate hides the flag
    for side, (right, down, forward) in SIDES.items():
        assert np.linalg.det(np.array([right, down, forward])) == pytest.approx(1), side


def test_points_without_faces_make_a_closed_surface(file):
    along, across = np.meshgrid(np.linspace(0, 1, 60), np.linspace(0, 1, 60))
    points = np.stack((along.ravel(), across.ravel(), 0.1 * along.ravel()), axis=1)
    file.write_bytes(ply_bytes(points, form="binary_little_endian", scalar="float"))
    depth = MeshSource(str(file)).read().depth_mm
    middle = depth[40:-40, 40:-40]  # the cut is a trapezium's bounding box
    assert (middle > 0).all()
    assert np.ptp(depth[depth > 0]) == pytest.approx(0.1 * OBJECT_MM, rel=0.05)
    thin = MeshSource(f"{file}?splat=1&size=1280x960").read().depth_mm
    assert 0.02 < (thin > 0).mean() < 0.1  # dots of 3 x 3 pixels, 15 apart


@pytest.mark.parametrize("points", [[(5, 5, 5)], [(0, 0, 0), (1e-310, 0, 0)], [(2, 2, 2)] * 9])
def test_one_point_is_seen(file, points):
    file.write_bytes(ply_bytes(points))
    assert MeshSource(str(file)).read().depth_mm.any()


def test_a_longer_lens_sees_the_object_from_farther_away(file):
    points, faces = cube()
    file.write_bytes(ply_bytes(points, faces))
    near = MeshSource(str(file)).read()
    far = MeshSource(f"{file}?focal=5850").read()
    assert abs(far.shape[0] - near.shape[0]) <= 2
    assert far.depth_mm.max() > 9 * near.depth_mm.max()


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ("side=inside", "front, back, left, right, top, bottom"),
        ("angle=3", "has no option 'angle'"),
        ("size=12", "WIDTHxHEIGHT"),
        ("splat=-1", "whole number"),
        ("frames=0", "whole number"),
    ],
)
def test_wrong_options_are_told_with_the_right_ones(file, options, says):
    file.write_bytes(ply_bytes(*cube()))
    with pytest.raises(SourceNotFoundError, match=says):
        open_source(f"{file}?{options}")


def test_an_object_that_is_edge_on_is_refused(file):
    file.write_bytes(ply_bytes([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)]))
    with pytest.raises(SourceNotFoundError, match="another side"):
        MeshSource(f"{file}?side=left")


def test_a_missing_file_is_told(file):
    with pytest.raises(SourceNotFoundError, match=r"object\.ply"):
        open_source(f"{file}?side=front")


def test_a_name_with_a_question_mark_is_a_name(tmp_path):
    path = tmp_path / "what?.ply"
    path.write_bytes(ply_bytes(*cube()))
    with open_source(path) as source:
        assert source.read().depth_mm.any()


def test_the_frame_is_delivered_as_often_as_asked(file):
    file.write_bytes(ply_bytes(*cube()))
    with MeshSource(f"{file}?frames=3") as source:
        frames = list(source)
    assert [frame.index for frame in frames] == [0, 1, 2]
    assert frames[2].timestamp_us == 66667
    with pytest.raises(SourceEndedError):
        source.read()


def test_the_bunny_looks_as_in_the_paper(shared_data):
    frame = open_source(f"{shared_data / 'bunny' / 'bunny.ply'}?side=front").read()
    height, width = frame.shape
    assert 380 < height <= 480
    assert 380 < width < 480
    # No row or column of the cut is empty, so a lattice lies over the object itself.
    assert (frame.depth_mm > 0).any(axis=0).all()
    assert (frame.depth_mm > 0).any(axis=1).all()
    share = (frame.depth_mm > 0).mean()
    assert 0.55 < share < 0.65
    # 84 x 84 seeds return about the 4,200 points that the paper states for its Fig. 1.
    assert int(SeedGrid.from_frame(frame, (84, 84)).valid.sum()) == pytest.approx(4200, rel=0.05)
    # The head is to the left and up, the tail to the right and low; the ear stands highest.
    assert math.isclose(np.flatnonzero(frame.depth_mm[0])[0] / width, 0.5, abs_tol=0.1)
