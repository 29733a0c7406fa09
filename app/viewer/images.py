"""Images in a recording stream, without what the SDK does to each: three copies, and its size told anew."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import rerun as rr

_PIXELS = rr.components.ImageBufferBatch([b""]).as_arrow_array().type
_CHANNELS = {np.dtype(np.uint8): rr.ChannelDatatype.U8, np.dtype(np.uint16): rr.ChannelDatatype.U16}


class ImageLogger:
    """Logs images, each entity's size and look but once: these are static, and the pixels are not.

    Parameters
    ----------
    stream : rr.RecordingStream
        Where to. It reads an image's memory until it is sent: nobody may change it after.
    """

    def __init__(self, stream: rr.RecordingStream) -> None:
        self._log = stream.log
        self._told: dict[str, dict[str, Any]] = {}

    def classes(self, entity: str, image: npt.NDArray[np.uint8], *, opaque: bool = False, static: bool = False) -> None:
        """Log an image of classes, uint8 of shape (height, width), drawn over others or instead of them."""
        self._send(rr.SegmentationImage, entity, image, {"opacity": 1.0} if opaque else {}, static)

    def depth(
        self,
        entity: str,
        depth_mm: npt.NDArray[np.uint16],
        colormap: rr.components.ColormapLike,
        limits_mm: tuple[float, float],
        *,
        static: bool = False,
    ) -> None:
        """Log a depth image, uint16 of shape (height, width), in colours between two depths."""
        look = {"meter": 1000.0, "colormap": colormap, "depth_range": list(limits_mm)}
        self._send(rr.DepthImage, entity, depth_mm, look, static)

    def _send(self, kind: Any, entity: str, image: npt.NDArray[Any], look: dict[str, Any], static: bool) -> None:
        height, width = image.shape
        look = {"format": rr.components.ImageFormat(width, height, channel_datatype=_CHANNELS[image.dtype]), **look}
        if self._told.get(entity) != look:
            self._told[entity] = look
            self._log(entity, kind.from_fields(**look), static=True)
        self._log(entity, kind.from_fields(buffer=_pixels(image)), static=static)


def _pixels(image: npt.NDArray[Any]) -> pa.Array:
    """An image's memory as the SDK holds images."""
    whole = np.ascontiguousarray(image)
    inner = pa.Array.from_buffers(pa.uint8(), whole.nbytes, [None, pa.py_buffer(whole)])
    return pa.ListArray.from_arrays(pa.array([0, whole.nbytes], pa.int32()), inner, type=_PIXELS)
