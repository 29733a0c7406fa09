"""ROS bags: the same frames through every kind of bag and every form of depth."""

from __future__ import annotations

import struct
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from mcap.reader import make_reader
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from selective_depth.app.cli import run
from selective_depth.drivers.bag import BagWriter
from selective_depth.drivers.errors import DamagedRecordingError, SourceError, SourceNotFoundError
from selective_depth.drivers.frame import Camera, DepthFrame
from selective_depth.drivers.open import open_source

Depth = npt.NDArray[np.uint16]
CAMERA = Camera(160, 120, 146.0, 147.0, 79.5, 59.5)
ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
COUNT = 30
TOPIC = "/camera/depth/image_raw"


@pytest.fixture(scope="module")
def frames() -> list[DepthFrame]:
    with open_source("virtual:workstation?size=160x120") as source:
        return [DepthFrame(source.read().depth_mm, n, 1_700_000_000_000_000 + n * 33_333, CAMERA) for n in range(COUNT)]


def header(store: Any, stamp_us: int) -> Any:
    seconds, rest_us = divmod(stamp_us, 1_000_000)
    stamp = store.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=rest_us * 1000)
    extra = {"seq": 0} if store is ROS1 else {}
    return store.types["std_msgs/msg/Header"](stamp=stamp, frame_id="depth", **extra)


def image(store: Any, frame: DepthFrame, encoding: str, pad: int = 0) -> Any:
    values = frame.depth_mm
    if encoding == "32FC1":
        values = np.where(values > 0, values / 1000, np.nan).astype(np.float32)
    rows = values.view(np.uint8).reshape(frame.shape[0], -1)
    rows = np.pad(rows, ((0, 0), (0, pad)))
    return store.types["sensor_msgs/msg/Image"](
        header(store, frame.timestamp_us),
        *frame.shape,
        encoding=encoding,
        is_bigendian=0,
        step=rows.shape[1],
        data=rows.reshape(-1),
    )


def compressed(store: Any, frame: DepthFrame, encoding: str) -> Any:
    near, far, values = 0.0, 0.0, frame.depth_mm
    if encoding == "32FC1":  # inverse depth, as compressed_depth_image_transport has it
        near = 100.0 * 101.0
        far = 1.0 - near / 10.0
        metres = np.where(frame.depth_mm > 0, frame.depth_mm / 1000, 1e9)
        values = np.where(frame.depth_mm > 0, near / metres + far, 0).astype(np.uint16)
    data = struct.pack("<iff", 0, near, far) + cv2.imencode(".png", values)[1].tobytes()
    return store.types["sensor_msgs/msg/CompressedImage"](
        header(store, frame.timestamp_us), format=f"{encoding}; compressedDepth png", data=np.frombuffer(data, np.uint8)
    )


def info(store: Any, frame: DepthFrame) -> Any:
    k = np.array([146.0, 0, 79.5, 0, 147.0, 59.5, 0, 0, 1])
    fields = {"d": np.zeros(5), "k": k, "r": np.eye(3).reshape(-1), "p": np.zeros(12)}
    if store is ROS1:
        fields = {name.upper(): value for name, value in fields.items()}
    roi = store.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    return store.types["sensor_msgs/msg/CameraInfo"](
        header(store, frame.timestamp_us),
        *frame.shape,
        distortion_model="plumb_bob",
        binning_x=0,
        binning_y=0,
        roi=roi,
        **fields,
    )


Topics = dict[str, Callable[[Any, DepthFrame], Any]]


def forms(form: str) -> Topics:
    topics: Topics = {"/camera/depth/camera_info": info}
    if form == "mm":
        topics[TOPIC] = lambda store, frame: image(store, frame, "16UC1")
    elif form == "m":
        topics[TOPIC] = lambda store, frame: image(store, frame, "32FC1", pad=8)
    else:
        encoding = "16UC1" if form == "compressed mm" else "32FC1"
        topics[f"{TOPIC}/compressedDepth"] = lambda store, frame: compressed(store, frame, encoding)
    return topics


def write(folder: Path, kind: str, topics: Topics, frames: list[DepthFrame]) -> Path:
    """A bag; colour, too, so that depth has to be found."""
    store = ROS1 if kind.startswith("bag") else ROS2
    path = folder / ("walk.bag" if store is ROS1 else "walk")
    writer: Any
    if store is ROS1:
        writer = Writer1(path)
        if "-" in kind:
            writer.set_compression(Writer1.CompressionFormat[kind.partition("-")[2].upper()])
    else:
        plugin = StoragePlugin.SQLITE3 if kind == "ros2" else StoragePlugin.MCAP
        writer = Writer2(path, version=8, storage_plugin=plugin)
        if kind == "mcap-zstd":
            writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    topics = {"/camera/color/image_raw": lambda s, f: image(s, f, "rgb8")} | topics
    with writer:
        made = {}
        for topic, make in topics.items():
            kinds = make(store, frames[0]).__msgtype__
            made[topic] = writer.add_connection(topic, kinds, typestore=store)
        for frame in frames:
            for topic, make in topics.items():
                message = make(store, frame)
                data = (store.serialize_ros1 if store is ROS1 else store.serialize_cdr)(message, message.__msgtype__)
                writer.write(made[topic], frame.timestamp_us * 1000, data)
    return next(path.glob("*.mcap")) if kind.startswith("mcap") else path


@pytest.mark.parametrize("form", ["mm", "m", "compressed mm", "compressed m"])
@pytest.mark.parametrize("kind", ["bag", "bag-bz2", "bag-lz4", "ros2", "mcap", "mcap-zstd"])
def test_the_same_frames_through_every_kind_of_bag(
    tmp_path: Path, frames: list[DepthFrame], kind: str, form: str
) -> None:
    few = frames if kind in ("bag", "ros2", "mcap") else frames[:3]
    path = write(tmp_path, kind, forms(form), few)
    with open_source(path) as source:
        assert source.camera == CAMERA
        assert source.frame_count == len(few)
        assert source.fps == pytest.approx(30, abs=0.1)
        assert f"topic {TOPIC}" in source.about and "camera_info" in source.about
        got = list(source)
    for frame, right in zip(got, few, strict=True):
        assert frame.timestamp_us == right.timestamp_us
        if form == "compressed m":  # quantised by its format
            known = right.depth_mm > 0
            off = np.abs(frame.depth_mm.astype(float) - right.depth_mm)[known]
            assert (off <= 0.5 + right.depth_mm[known] ** 2.0 / 1e7).all()
        else:
            np.testing.assert_array_equal(frame.depth_mm, right.depth_mm)


@pytest.mark.parametrize("name", ["out.mcap", "out.ros2"])
def test_what_is_exported_is_read_back(
    tmp_path: Path, frames: list[DepthFrame], name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = write(tmp_path, "bag", forms("mm"), frames), tmp_path / name
    assert run(["export", str(path), str(out)]) == 0
    assert "is read as a ROS bag, topic /camera/depth/image_raw" in capsys.readouterr().out
    assert not list(tmp_path.glob("*.part"))
    with open_source(out) as source:
        assert source.camera == CAMERA
        for frame, right in zip(source, frames, strict=True):
            assert frame.timestamp_us == right.timestamp_us
            np.testing.assert_array_equal(frame.depth_mm, right.depth_mm)
    assert run(["export", str(path), str(out)]) == 1
    assert "exists already" in capsys.readouterr().err
    if name == "out.mcap":
        with out.open("rb") as file:
            images = [
                message
                for _, channel, message in make_reader(file).iter_messages()
                if channel.topic.endswith("image_rect_raw")
            ]
        assert len(images) == COUNT
        for message, right in zip(images, frames, strict=True):
            data = ROS2.deserialize_cdr(message.data, "sensor_msgs/msg/Image").data
            assert bytes(data) == right.depth_mm.tobytes()
            assert message.log_time == right.timestamp_us * 1000


def test_of_several_depth_topics_one_is_asked_for(
    tmp_path: Path, frames: list[DepthFrame], capsys: pytest.CaptureFixture[str]
) -> None:
    other = {"/aligned/image": lambda s, f: image(s, f, "16UC1")}
    path = write(tmp_path, "mcap", forms("mm") | other, frames[:3])
    with pytest.raises(SourceNotFoundError, match=r"several: .*/aligned/image.*--topic"):
        open_source(path)
    with open_source(f"{path}?topic=/aligned/image") as source:
        assert "camera_info" not in source.about and source.camera == Camera.kinect(160, 120)
    assert run(["export", str(path), str(tmp_path / "out"), "--topic", TOPIC]) == 0
    assert f"topic {TOPIC}" in capsys.readouterr().out
    with pytest.raises(SourceNotFoundError, match=r"no topic '/x'; images: /"):
        open_source(f"{path}?topic=/x")
    with pytest.raises(SourceNotFoundError, match="holds rgb8"):
        open_source(f"{path}?topic=/camera/color/image_raw")


def test_raw_is_taken_before_its_own_compressed_form(tmp_path: Path, frames: list[DepthFrame]) -> None:
    path = write(tmp_path, "mcap", forms("mm") | forms("compressed mm"), frames[:3])
    with open_source(path) as source:
        assert f"topic {TOPIC}:" in source.about


def test_realsense_recordings_say_their_unit(tmp_path: Path, frames: list[DepthFrame]) -> None:
    sensor = "/device_0/sensor_0"
    topics: Topics = {
        f"{sensor}/Depth_0/image/data": lambda s, f: image(s, f, "mono16"),
        f"{sensor}/Infrared_1/image/data": lambda s, f: image(s, f, "mono16"),
        f"{sensor}/Depth_0/info/camera_info": info,
        f"{sensor}/option/Depth_Units/value": lambda s, f: s.types["std_msgs/msg/Float32"](0.0005),
    }
    path = write(tmp_path, "bag", topics, frames[:3])
    with open_source(path) as source:
        assert "Depth_0/image/data: 2000 values a metre (as the bag says)" in source.about
        assert source.camera == CAMERA
        right = np.rint(frames[0].depth_mm / 2)
        np.testing.assert_array_equal(source.read().depth_mm, right)
    with open_source(f"{path}?scale=1000&camera=1,2,3,4") as source:
        assert source.camera == Camera(160, 120, 1, 2, 3, 4)
        np.testing.assert_array_equal(source.read().depth_mm, frames[0].depth_mm)


@pytest.mark.parametrize("kind", ["bag", "ros2", "mcap"])
@pytest.mark.parametrize("keep", [0.0, 0.5, 0.97])
def test_a_cut_bag_says_how_to_mend_it(tmp_path: Path, frames: list[DepthFrame], kind: str, keep: float) -> None:
    path = write(tmp_path, kind, forms("mm"), frames[:5])
    cut = next(path.glob("*.db3")) if kind == "ros2" else path
    data = cut.read_bytes()
    cut.write_bytes(data[: int(len(data) * keep)])
    mend = {"bag": "rosbag reindex", "ros2": "ros2 bag reindex", "mcap": "mcap recover"}[kind]
    with pytest.raises(DamagedRecordingError, match=mend), open_source(path) as source:
        list(source)


def test_without_the_package_it_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, frames: list[DepthFrame]
) -> None:
    path = write(tmp_path, "bag", forms("mm"), frames[:2])
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(SourceError, match=r"pip install 'selective-depth\[ros\]'"):
        open_source(path)


# Colour beside depth


def colour_of(frame: DepthFrame) -> npt.NDArray[np.uint8]:
    rows, columns = np.mgrid[0:120, 0:160]
    return np.stack((columns, rows, np.full_like(rows, 7 * frame.index)), axis=-1).astype(np.uint8)


def colour_message(form: str, late_us: int) -> Callable[[Any, DepthFrame], Any]:
    def make(store: Any, frame: DepthFrame) -> Any:
        rgb, head = colour_of(frame), header(store, frame.timestamp_us + late_us)
        if form == "jpeg":
            data = np.frombuffer(cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 100])[1], np.uint8)
            return store.types["sensor_msgs/msg/CompressedImage"](head, format="rgb8; jpeg compressed bgr8", data=data)
        pixels = {"rgb8": rgb, "bgr8": rgb[..., ::-1], "mono8": cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)}[form]
        padded = np.pad(np.ascontiguousarray(pixels).reshape(120, -1), ((0, 0), (0, 5)))
        return store.types["sensor_msgs/msg/Image"](
            head, 120, 160, encoding=form, is_bigendian=0, step=padded.shape[1], data=padded.reshape(-1)
        )

    return make


@pytest.mark.parametrize("kind", ["bag", "ros2", "mcap"])
@pytest.mark.parametrize("form", ["rgb8", "bgr8", "mono8", "jpeg"])
def test_colour_is_the_nearest_in_time(tmp_path: Path, frames: list[DepthFrame], kind: str, form: str) -> None:
    topic = "/camera/color/image_raw" + ("/compressed" if form == "jpeg" else "")
    topics = {topic: colour_message(form, 9_000), "/camera/infra1/image_raw": colour_message("mono8", 0), **forms("mm")}
    if form == "jpeg":
        topics["/camera/color/image_raw"] = lambda store, frame: image(store, frame, "odd")
    with open_source(write(tmp_path, kind, topics, frames[:6])) as source:
        assert f"colour from {topic}" in source.about
        for before, after in zip(frames, source, strict=False):
            assert after.colour is not None and after.colour_us == before.timestamp_us + 9_000 and not after.registered
            wanted = colour_of(before)
            if form == "mono8":
                wanted = np.repeat(cv2.cvtColor(wanted, cv2.COLOR_RGB2GRAY)[..., None], 3, axis=2)
            assert np.abs(after.colour.astype(int) - wanted).max() <= (20 if form == "jpeg" else 0)


@pytest.mark.parametrize("registered", [True, False])
@pytest.mark.parametrize("name", ["x.mcap", "x.ros2"])
def test_written_colour_comes_back(tmp_path: Path, frames: list[DepthFrame], name: str, registered: bool) -> None:
    other = Camera(160, 120, 150.0, 151.0, 80.5, 61.0)
    given = [
        DepthFrame(
            frame.depth_mm,
            frame.index,
            frame.timestamp_us,
            CAMERA,
            colour=None if frame.index == 2 else colour_of(frame),
            colour_us=frame.timestamp_us - 4_000,
            colour_camera=None if registered else other,
            registered=registered,
        )
        for frame in frames[:5]
    ]
    with BagWriter(tmp_path / name) as writer:
        for frame in given:
            writer.write(frame)
    with open_source(tmp_path / name) as source:
        for before, after in zip(given, source, strict=True):
            np.testing.assert_array_equal(before.depth_mm, after.depth_mm)
            assert (after.colour is None) == (before.colour is None)
            if before.colour is not None and after.colour is not None:
                np.testing.assert_array_equal(before.colour, after.colour)
                assert after.colour_us == before.colour_us and after.registered == registered
                assert after.colour_camera == (CAMERA if registered else other)
    with open_source(f"{tmp_path / name}?colour=off") as source:
        assert source.read().colour is None
