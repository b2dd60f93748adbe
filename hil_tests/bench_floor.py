"""``python -m hil_tests.bench_floor``: the least that could answer a state.

A Zenoh callback, onnxruntime on the frames, and a put of a command: no validation, no watchdog, no
limits. What the edge runtime costs is measured against this.
"""

from __future__ import annotations

import signal
import sys
import threading

import msgspec
import numpy as np
import onnxruntime
import zenoh

from edge_runtime.transport import open_session
from edge_runtime.wire import DRIVE, Command, State, encode, key


def main(policy: str, connect: str, vehicle_id: str) -> None:
    """Answer until SIGTERM."""
    end = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: end.set())
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    network = onnxruntime.InferenceSession(policy, options, providers=["CPUExecutionProvider"])
    decode = msgspec.msgpack.Decoder(State).decode

    def on_state(sample: zenoh.Sample) -> None:
        state = decode(bytes(sample.payload))
        frames = np.frombuffer(state.observation["frames"], np.uint8).reshape(1, 2, 45, 80)
        (actions,) = network.run(["action"], {"frames": frames})
        command = Command(
            session=state.session, episode=state.episode, step=state.step, mode=DRIVE,
            action=actions[0].tolist(), policy_id="0" * 64, received_ns=state.sent_ns,
            inference_ns=0, sent_ns=state.sent_ns,
        )  # fmt: skip
        publisher.put(encode(command))

    with (
        open_session(connect=connect, mode="peer") as session,
        session.declare_publisher(
            key(vehicle_id, "command"),
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.REAL_TIME,
            express=True,
        ) as publisher,
        session.declare_subscriber(key(vehicle_id, "state"), on_state),
    ):
        print("ready", flush=True)
        end.wait()


if __name__ == "__main__":
    main(*sys.argv[1:])
