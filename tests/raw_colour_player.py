"""Plays the colour of an .oni file through OpenNI2 itself; prints the mean red, green, blue of each frame."""

from __future__ import annotations

import json
import os
import sys

import numpy as np
from primesense import openni2


def main(library: str, path: str) -> None:
    folder, openni2._dll_name = os.path.split(library)
    openni2.initialize(folder)
    device = openni2.Device.open_file(os.fsencode(path))
    stream = device.create_color_stream()
    device.playback.set_speed(-1.0)
    wanted = device.playback.get_number_of_frames(stream)
    stream.start()
    means: list[list[float]] = []
    while len(means) < wanted and openni2.wait_for_any_stream([stream], 2.0) is not None:
        frame = stream.read_frame()
        image = np.frombuffer(frame.get_buffer_as_uint8(), np.uint8).reshape(frame.height, frame.width, 3)
        means.append([float(each) for each in image.mean(axis=(0, 1))])
        frame.close()
    print(json.dumps(means), flush=True)
    os._exit(0)  # the runtime's own way out can crash


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
