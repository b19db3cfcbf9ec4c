"""Process that renders the images of one camera; started by `drawing.ProcessRendering` only.

It is a separate module, so that the process imports what rendering needs, and nothing else of the node that starts it.
"""

from __future__ import annotations

import signal
import sys
from contextlib import suppress
from multiprocessing.connection import Connection

import cv2
import numpy as np

from perch_core.processes import end_with_parent, lower_priority
from perch_sim.rendering import Renderer

READY_MESSAGE = b"ready"
NICE = 5  # below the step; processes that wait for an image lower their own priority (perch_core/ros/priority.py)


def render_until_closed(requests: Connection, images: Connection) -> None:
    """Receive scene, mount and seed; report readiness; then render one image per request, the arguments of `Renderer.render`."""
    renderer = Renderer(*requests.recv())
    renderer.render([(np.array([0.0, 0.0, 1.0]), np.eye(3))], np.random.default_rng(0))  # loads what is compiled
    images.send_bytes(READY_MESSAGE)
    while True:
        images.send_bytes(renderer.render(*requests.recv()).ravel().data)


def main() -> None:
    """Serve the pipes of requests and of images, whose file numbers are on the command line."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the caller decides when this ends
    end_with_parent(signal.SIGTERM)
    lower_priority(0, NICE)
    cv2.setNumThreads(1)
    with suppress(EOFError, BrokenPipeError):
        render_until_closed(Connection(int(sys.argv[1])), Connection(int(sys.argv[2])))


if __name__ == "__main__":
    main()
