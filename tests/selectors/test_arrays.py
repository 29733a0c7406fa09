"""Whatever kind of array is given, every function answers as to the plain one, or says why not."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from conftest import ROOT

from selective_depth.selectors.acquire import SurfaceSelector, acquire
from selective_depth.selectors.arrays import FARTHEST_MM, checked_map, measured_mm, pixels_in
from selective_depth.selectors.choice import choose
from selective_depth.selectors.improvement import ImprovementSelector, improvement_scattered
from selective_depth.selectors.neural_gas import NeuralGasSelector
from selective_depth.selectors.reconstruct import reconstruct
from selective_depth.selectors.samples import Samples
from selective_depth.selectors.seeds import SeedGrid

HEIGHT, WIDTH = 48, 64
PLAIN = np.full((HEIGHT, WIDTH), 2000, np.uint16)
PLAIN[12:30, 20:44] = 1200
PLAIN[:, :9] = 0
NOTHING = PLAIN == 0


def marked(none: float) -> npt.NDArray[np.float64]:
    return np.where(NOTHING, none, PLAIN.astype(np.float64))


KINDS: dict[str, npt.NDArray[Any]] = {
    "uint16": PLAIN,
    "int32": PLAIN.astype(np.int32),
    "negative for none": marked(-1).astype(np.int32),
    "float64": PLAIN.astype(np.float64),
    "big-endian": PLAIN.astype(">u2"),
    "big-endian floats": PLAIN.astype(">f4"),
    "column by column": np.asfortranarray(PLAIN),
    "every second": np.repeat(np.repeat(PLAIN, 2, 0), 2, 1)[::2, ::2],
    "backwards": PLAIN[::-1, ::-1].copy()[::-1, ::-1],
    "read-only": np.frombuffer(PLAIN.tobytes(), np.uint16).reshape(HEIGHT, WIDTH),
    "masked": np.ma.masked_array(np.where(NOTHING, 65535, PLAIN), NOTHING),
    "masked nowhere": np.ma.asarray(PLAIN),
    **{f"{none} for none": marked(none) for none in (np.nan, np.inf, -np.inf, 1e10, 1e20)},
    "3.4e38 for none": marked(3.4e38).astype(np.float32),
    "more than a float holds": marked(1e300),
}
ROWS, COLUMNS = np.indices(PLAIN.shape)[:, ::3, ::3].reshape(2, -1)
UV = np.stack((COLUMNS, ROWS), axis=-1).astype(np.int32)


def added(depth: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    samples = Samples(PLAIN.shape)
    samples.add(UV, depth[UV[:, 1], UV[:, 0]])
    return samples.image_mm


def answered(depth: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    seeds = SeedGrid.from_array(PLAIN, (12, 16))
    return acquire(lambda uv: depth[uv[:, 1], uv[:, 0]], seeds, 0.1, 3).reconstruct()


FUNCTIONS: dict[str, Callable[[npt.NDArray[Any]], npt.NDArray[Any]]] = {
    "SeedGrid.from_array": lambda d: SeedGrid.from_array(d, (12, 16)).depth_mm,
    "Samples.add": added,
    "reconstruct": lambda d: reconstruct(UV, d[UV[:, 1], UV[:, 0]], PLAIN.shape),
    "improvement_scattered": lambda d: improvement_scattered(UV, d[UV[:, 1], UV[:, 0]], PLAIN.shape).raw,
    "ImprovementSelector": lambda d: ImprovementSelector().select(SeedGrid.from_array(d, (12, 16))).score,
    "NeuralGasSelector": lambda d: NeuralGasSelector(nodes=40).select(SeedGrid.from_array(d, (12, 16))).nodes_mm,
    "SurfaceSelector": lambda d: SurfaceSelector().select(SeedGrid.from_array(d, (12, 16))).score,
    "acquire": answered,
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_function_takes_every_kind_of_depth_as_the_plain_one(name: str, kind: str) -> None:
    given = KINDS[kind]
    before = np.ma.getdata(given).tobytes()
    result = FUNCTIONS[name](given)
    assert type(result) is np.ndarray
    np.testing.assert_array_equal(result, FUNCTIONS[name](PLAIN))
    assert np.ma.getdata(given).tobytes() == before, "what is given is not written to"


@pytest.mark.parametrize("wrong", [PLAIN > 0, PLAIN.astype(complex), PLAIN.astype(str)])
def test_what_is_no_number_is_refused(wrong: npt.NDArray[Any]) -> None:
    with pytest.raises(ValueError, match="give numbers, depth in millimetres"):
        measured_mm(wrong)


def test_the_farthest_depth_is_the_last_that_counts() -> None:
    given = np.array([FARTHEST_MM, np.nextafter(FARTHEST_MM, np.inf), 1e-3])
    assert measured_mm(given).tolist()[0] == FARTHEST_MM
    assert (measured_mm(given * [1, 1.01, 1]) > 0).tolist() == [True, False, True]


@pytest.mark.parametrize(
    ("uv", "words"),
    [
        (UV.astype(float), "whole numbers"),
        (UV.T, "whole numbers of shape"),
        (np.ma.masked_array(UV, UV == 3), "masked elements"),
        (UV[:, ::-1], "the row seems to come first"),
        (UV + 64, "lies outside the frame of 64x48"),
        (UV - 1, "lies outside the frame"),
    ],
)
def test_pixels_that_cannot_be_are_refused(uv: npt.NDArray[Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        pixels_in(uv, PLAIN.shape)


@pytest.mark.parametrize("kind", [np.uint8, np.int16, ">i4", np.uint64, np.int64])
def test_pixels_of_any_whole_kind_are_taken(kind: Any) -> None:
    found = pixels_in(np.asfortranarray(UV.astype(kind)), PLAIN.shape)
    assert found.dtype == np.int32 and found.flags.c_contiguous
    np.testing.assert_array_equal(found, UV)


def test_a_worth_is_made_good() -> None:
    worth = np.ma.masked_array([[1, -2, np.nan], [np.inf, 7, 3]], [[0, 0, 0], [0, 1, 0]])
    made = checked_map(worth, (2, 3), "worth")
    assert made.tolist()[0] == [1, 0, 0]
    assert made[1].tolist() == [np.finfo(np.float32).max, 0, 3]
    assert choose(worth, 1).tolist() == [[0, 1]]
    with pytest.raises(ValueError, match="worth must be a number for every pixel"):
        checked_map(worth, (3, 2), "worth")


def test_one_gas_selector_serves_several_threads() -> None:
    grids = [SeedGrid.from_array(np.roll(PLAIN, k, axis=0), (24, 32)) for k in (0, 15)]
    gas = NeuralGasSelector(nodes=100)
    right = [gas.select(grid).nodes_mm.copy() for grid in grids]
    wrong: list[int] = []

    def camera(number: int) -> None:
        for _ in range(6):
            if not np.array_equal(gas.select(grids[number]).nodes_mm, right[number]):
                wrong.append(number)

    crew = [threading.Thread(target=camera, args=(number,)) for number in range(2)]
    for each in crew:
        each.start()
    for each in crew:
        each.join()
    assert not wrong


BOUNDS = """
import numpy as np
from selective_depth.drivers.frame import Camera
from selective_depth.drivers.oni.codec import decode_depth, encode_depth
from selective_depth.drivers.oni.records import CODEC_PLAIN, CODEC_TABLE
from selective_depth.drivers.virtual.noise import kinect_depth
from selective_depth.drivers.open import open_source
from selective_depth.selectors.acquire import StepSelector, SurfaceSelector, acquire
from selective_depth.selectors.improvement import ImprovementSelector, improvement_scattered
from selective_depth.selectors.neural_gas import LongEdgeSelector, NeuralGasSelector
from selective_depth.selectors.seeds import SeedGrid

tried = 0
for seed in range(ROUNDS):
    rng = np.random.default_rng(seed)
    height, width = (int(n) for n in rng.integers(2, 150, 2))
    far = rng.choice([0.0, 1.0, 65535.0, 1e7, 1e10, 3e38, np.inf, np.nan])
    depth = rng.uniform(1, rng.choice([10, 4000, 65535, 1e7]), (height, width))
    depth[rng.random(depth.shape) < rng.random()] = far
    rows, columns = int(rng.integers(1, height + 1)), int(rng.integers(1, width + 1))
    seeds = SeedGrid.from_array(depth, (rows, columns))
    measure = lambda uv: depth[uv[:, 1], uv[:, 0]]
    gas = NeuralGasSelector(nodes=int(rng.integers(1, 60)), epochs=2, algorithm="exact")
    selectors = (SurfaceSelector(), StepSelector(), ImprovementSelector(), gas,
                 LongEdgeSelector(NeuralGasSelector(nodes=30)))
    for selector in selectors:
        try:
            budget, many = float(rng.random()), int(rng.integers(1, 5))
            acquire(measure, seeds, budget, many, selector).reconstruct()
        except ValueError:
            pass  # a sentence, such as too few seeds for the nodes
        tried += 1
    whole = np.nan_to_num(depth, nan=0, posinf=0).clip(0, 9999).astype(np.uint16)
    payload = encode_depth(whole)
    assert np.array_equal(decode_depth(CODEC_TABLE, payload, height, width), whole)
    for codec in (CODEC_TABLE, CODEC_PLAIN):
        damaged = bytearray(payload)
        for _ in range(5):
            damaged[int(rng.integers(len(damaged)))] = int(rng.integers(256))
        decode_depth(codec, bytes(damaged), height, width)
        tried += 1
    live = NeuralGasSelector(nodes=30)
    for _ in range(3):
        try:
            live.update(seeds)
        except ValueError:
            pass
        tried += 1
corner = np.random.default_rng(0).normal(size=(60, 3))
with open(FILE, "w") as file:
    file.write("ply\\nformat ascii 1.0\\nelement vertex 60\\nproperty float x\\n")
    file.write("property float y\\nproperty float z\\nelement face 40\\n")
    file.write("property list uchar int vertex_indices\\nend_header\\n")
    for point in corner:
        file.write(" ".join(map(str, point)) + "\\n")
    for face in range(40):
        sides = 3 + face % 3
        file.write(f"{sides} " + " ".join(str((face + k) % 60) for k in range(sides)) + "\\n")
for side in ("front", "left", "top"):
    with open_source(FILE + f"?side={side}") as source:
        source.read()
    tried += 1
for scene in ("workstation", "ball", "firehose"):
    with open_source(f"virtual:{scene}?frames=1&size=160x120") as source:
        source.read()
    tried += 1
print(tried)
"""


@pytest.mark.slow
def test_no_kernel_leaves_its_arrays(tmp_path: Path) -> None:
    """Every kernel with the bounds of its arrays checked, on random and extreme input."""
    done = subprocess.run(
        [sys.executable, "-c", BOUNDS.replace("ROUNDS", "40").replace("FILE", repr(str(tmp_path / "some.ply")))],
        cwd=ROOT,
        env={**os.environ, "NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    print(f"{done.stdout.strip()} calls with bounds checked: none left its arrays")
