"""Opening any depth source by its name: the only module that knows all kinds."""

from __future__ import annotations

from pathlib import Path

from selective_depth.drivers.colour import Colouring
from selective_depth.drivers.errors import SourceNotFoundError
from selective_depth.drivers.options import Options, parted
from selective_depth.drivers.source import DepthSource

_WHAT_THERE_IS = "Give an .oni file, a folder of 16-bit PNG frames, 'openni' for a sensor, or 'virtual:workstation'."


def open_source(uri: str | Path) -> DepthSource:
    """Open any depth source by its name.

    Parameters
    ----------
    uri : str or Path
        ``openni`` or ``openni:<device uri>``, a live sensor through OpenNI2;
        ``<file>.oni``, a recording, replayed frame by frame (``?stream=2``: its second depth);
        ``<folder>``, depth images in one of two dozen layouts; ``<file>.npy`` or ``.npz``;
        after ``?`` their ``scale`` (values per metre) and ``camera`` (fx,fy,cx,cy);
        ``<file>.bag``, ``<file>.mcap`` or the folder of a ROS 2 bag, with a ``topic``;
        ``virtual:<scene>``, a virtual Kinect in a made scene, with options after ``?``;
        ``<file>.ply``, an object seen from a chosen side.

    Raises
    ------
    SourceError
        One of its named kinds; the message says what was tried and what to do next.
    """
    # Each kind is imported where it is opened: a PNG folder must not need OpenNI2, and
    # `--help` must not wait for numba.
    name = str(uri)
    if not name:  # which a path would take for this folder
        raise SourceNotFoundError(f"a source with no name was given. {_WHAT_THERE_IS}")
    scheme, _, rest = name.partition(":")
    if scheme.partition("?")[0] == "openni":
        from selective_depth.drivers.openni import OpenNIDevice, parse_address

        return OpenNIDevice(*parse_address(name[6:].removeprefix(":")))
    if scheme == "virtual":
        from selective_depth.drivers.virtual import VirtualSource

        return VirtualSource(rest)
    named, query = parted(name)
    path, options = Path(named), Options(query, f"'{named}'")
    suffix = path.suffix.lower()
    if suffix == ".ply":
        from selective_depth.drivers.virtual import MeshSource

        return MeshSource(name)
    if suffix in (".bag", ".mcap", ".db3") or (path / "metadata.yaml").is_file():
        from selective_depth.drivers.bag import BagReader

        scale, intrinsics = options.scale(), options.camera()
        topic, colouring = options.text("topic", "a topic's name"), Colouring.of(options)
        options.done()
        return BagReader(path, topic=topic, values_per_metre=scale, intrinsics=intrinsics, colouring=colouring)
    if path.is_dir() or (suffix in (".npy", ".npz") and path.exists()):
        from selective_depth.drivers.folder import RecordedFolder

        scale, intrinsics, colouring = options.scale(), options.camera(), Colouring.of(options)
        options.done()
        return RecordedFolder(path, values_per_metre=scale, intrinsics=intrinsics, colouring=colouring)
    if suffix == ".oni":
        from selective_depth.drivers.oni import OniReader

        stream, intrinsics = options.integer("stream", 1, 1, 64), options.camera()
        colouring = Colouring.of(options)
        options.done()
        return OniReader(path, stream=stream, intrinsics=intrinsics, colouring=colouring)
    if not path.exists():
        raise SourceNotFoundError(f"'{named}' does not exist. {_WHAT_THERE_IS}")
    raise SourceNotFoundError(
        f"'{named}' is not a depth source: a recording ends in .oni, an object in .ply, an array in"
        " .npy or .npz, a ROS bag in .bag or .mcap, and PNG frames are given by their folder."
    )
