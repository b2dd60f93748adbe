"""``python -m hil_tests.bench_floor``: the least that could answer a state.

A Zenoh callback, onnxruntime on the frames, and a put of a reply of the size that it is told:
no validation, no watchdog, no limits. What the edge runtime costs is measured against this.
"""

from __future__ import annotations

import signal
import sys
import threading

import numpy as np
import onnxruntime
import zenoh

from edge_runtime.transport import open_session
from edge_runtime.wire import FRAMES_BYTES, FRAMES_SHAPE, key

STEP_BYTES = 8


def main(policy: str, connect: str, vehicle_id: str, reply_bytes: int) -> None:
    """Answer until SIGTERM. A payload is the step, the frames, and padding."""
    end = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: end.set())
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    network = onnxruntime.InferenceSession(policy, options, providers=["CPUExecutionProvider"])
    session = open_session(connect=connect, mode="peer")
    publisher = session.declare_publisher(
        key(vehicle_id, "command"),
        congestion_control=zenoh.CongestionControl.DROP,
        priority=zenoh.Priority.REAL_TIME,
        express=True,
    )
    padding = bytes(reply_bytes - STEP_BYTES)

    def on_state(sample: zenoh.Sample) -> None:
        payload = bytes(sample.payload)
        frames = np.frombuffer(payload, np.uint8, FRAMES_BYTES, STEP_BYTES)
        network.run(["action"], {"frames": frames.reshape(1, *FRAMES_SHAPE)})
        publisher.put(payload[:STEP_BYTES] + padding)

    subscriber = session.declare_subscriber(key(vehicle_id, "state"), on_state)
    print("ready", flush=True)
    end.wait()
    subscriber.undeclare()
    publisher.undeclare()
    session.close()


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], sys.argv[3], int(sys.argv[4]))
