"""The two processes under the bench, behind one interface: a state by its step, and its answer."""

from __future__ import annotations

import time

import numpy as np
import zenoh

from edge_runtime import wire
from edge_runtime.wire import FRAMES_BYTES, FRAMES_SHAPE
from hil_tests.benches.floor import STEP_BYTES
from hil_tests.faults.processes import Process, wait_until

OURS, FLOOR = "bench-ours", "bench-floor"
PICTURES = 64
_ROUSE_EVERY_S = 0.02


def pictures(seed: int = 0) -> list[bytes]:
    """Frames of noise, the same for both."""
    generator = np.random.default_rng(seed)
    return [
        generator.integers(0, 256, FRAMES_SHAPE, dtype=np.uint8).tobytes() for _ in range(PICTURES)
    ]


class Contender:
    """Sends states to one process; ``arrivals`` holds when the answer to each step came."""

    def __init__(self, session: zenoh.Session, vehicle_id: str) -> None:
        self.arrivals: dict[int, float] = {}
        self.vehicle_id = vehicle_id
        self._pictures = pictures()
        self._step = 0
        self._publisher = session.declare_publisher(
            wire.key(vehicle_id, "state"), congestion_control=zenoh.CongestionControl.DROP
        )
        self._subscriber = session.declare_subscriber(
            wire.key(vehicle_id, "command"), self._on_command
        )

    def begin_block(self) -> None:
        """Before the first state of a block."""
        self.arrivals.clear()

    def end_block(self) -> None:
        """After the last one."""

    def prepare(self) -> tuple[int, bytes]:
        """The next step and its payload."""
        self._step += 1
        return self._step, self._payload(self._step, self._pictures[self._step % PICTURES])

    def put(self, payload: bytes) -> None:
        """Send it."""
        self._publisher.put(payload)

    def close(self) -> None:
        """Undeclare."""
        self._subscriber.undeclare()
        self._publisher.undeclare()

    def _on_command(self, sample: zenoh.Sample) -> None:
        arrived_s = time.perf_counter()
        self.arrivals.setdefault(self._step_of(bytes(sample.payload)), arrived_s)

    def _payload(self, step: int, frames: bytes) -> bytes:
        raise NotImplementedError

    def _step_of(self, payload: bytes) -> int:
        raise NotImplementedError


class Ours(Contender):
    """`edge_runtime run`: real states, real commands. A block is an episode."""

    def __init__(self, session: zenoh.Session) -> None:
        super().__init__(session, OURS)
        self.reply_bytes = 0
        self.modes: dict[str, int] = {}
        self._episode = 0

    def end_block(self) -> None:
        """A final state: it stands by while the other one works."""
        self._step += 1
        self.put(self._payload(self._step, self._pictures[0], final=True))
        self._episode += 1

    def _payload(self, step: int, frames: bytes, final: bool = False) -> bytes:
        state = wire.State(
            session="bench",
            episode=self._episode,
            step=step,
            sim_time_s=step * wire.CONTROL_PERIOD_S,
            sent_ns=time.time_ns(),
            frames=frames,
            speed_mps=3.0,
            final=final,
        )
        return wire.encode(state)

    def _step_of(self, payload: bytes) -> int:
        command = wire.decode_command(payload)
        assert isinstance(command, wire.Command), command
        self.reply_bytes = len(payload)
        self.modes[command.mode] = self.modes.get(command.mode, 0) + 1
        return command.step


class Floor(Contender):
    """The bare process: the step, the frames, and padding to the size of a state."""

    def __init__(self, session: zenoh.Session, state_bytes: int) -> None:
        super().__init__(session, FLOOR)
        self._padding = bytes(state_bytes - FRAMES_BYTES - STEP_BYTES)

    def _payload(self, step: int, frames: bytes) -> bytes:
        return step.to_bytes(STEP_BYTES, "big") + frames + self._padding

    def _step_of(self, payload: bytes) -> int:
        return int.from_bytes(payload[:STEP_BYTES], "big")


def start_ours(policy: list[str], endpoint: str) -> Process:
    """The real edge runtime, not waited for."""
    arguments = [*policy, "--connect", endpoint, "--vehicle-id", OURS]
    return Process("edge_runtime", "run", *arguments)


def start_floor(policy: str, endpoint: str, reply_bytes: int) -> Process:
    """The bare process, not waited for."""
    return Process("hil_tests.benches.floor", policy, endpoint, FLOOR, str(reply_bytes))


def rouse(contender: Contender) -> None:
    """Send states until the first answer: a process that is ready may not be known here yet."""
    contender.begin_block()

    def is_answered() -> bool:
        contender.put(contender.prepare()[1])
        time.sleep(_ROUSE_EVERY_S)
        return bool(contender.arrivals)

    wait_until(is_answered, f"{contender.vehicle_id} answers")


def answer(contender: Contender, timeout_s: float) -> float:
    """Send one state and wait for its answer: when it came (perf_counter); TimeoutError."""
    step, payload = contender.prepare()
    contender.put(payload)
    end_s = time.perf_counter() + timeout_s
    while step not in contender.arrivals:
        if time.perf_counter() > end_s:
            raise TimeoutError(f"{contender.vehicle_id} does not answer step {step}")
        time.sleep(0.0001)
    return contender.arrivals[step]
