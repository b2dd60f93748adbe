"""Record a sitting: every step is written as soon as it is driven.

One MCAP file a sitting, whose messages are whole transitions (``RecordedStep``) in MessagePack,
each in a chunk of its own, handed to the operating system at once: a kill loses one step at most.
30 minutes are about 14 MB. Nothing is ever overwritten.
"""

import io
import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from mcap.stream_reader import MAGIC_SIZE
from numpy.typing import NDArray

from bridge.outcomes import DISCARDED
from bridge.recording import Recording, new_recording_at
from edge_runtime.util import UserError
from trainer.environments import check_recorded
from trainer.learner.replay import Transition
from trainer.person import Amount, Control, vector

TOPIC = "person/step"
DIRECTORY = "sittings"  # Where a training run keeps its recordings
NAME = re.compile(r"sitting-(\d{4,})\.mcap")


class RecordedStep(msgspec.Struct, frozen=True):
    """One control period: a transition, and the actions of policy and person."""

    sitting: int
    index: int  # The step's number in the sitting, from 0
    scenario: str
    seed: int  # The episode's
    episode: int
    step: int  # In the episode, from 0
    time_ns: int  # When the device was read: wall time, ns since 1970
    time_s: float  # Simulated, since the episode's start
    seen: bytes  # s: the policy's observation, as an .npy file
    seen_next: bytes  # s', likewise
    policy_action: Amount | None
    human_action: Amount  # The device's action
    action: Amount  # The applied action
    control: Control
    human: bool  # The mask Delta
    first: bool  # Whether an intervention began here
    reward: float  # Without the shaping of eq. 17
    terminated: bool
    truncated: bool
    speed_mps: float
    outcome: str = ""  # How the episode ended here, if it did
    ahead: tuple[bytes, ...] = ()
    """Observations predicted for the policy's action, if the algorithm looks ahead."""

    @property
    def observation(self) -> NDArray[Any]:
        """State s; of our scenarios uint8 [2, 45, 80]."""
        return _unpacked(self.seen)

    @property
    def next_observation(self) -> NDArray[Any]:
        return _unpacked(self.seen_next)

    def transition(self, penalised: bool = False) -> Transition:
        """Return the step's transition; ``penalised`` is given, since the recording lacks it."""
        overruled = None if self.policy_action is None else vector(self.policy_action)
        foreseen = tuple(map(_unpacked, (self.seen, *self.ahead))) if self.ahead else ()
        return Transition(
            self.observation, vector(self.action), self.reward, self.next_observation,
            self.terminated, self.truncated, self.human, overruled, penalised, foreseen,
        )  # fmt: skip


def packed(array: NDArray[Any]) -> bytes:
    """Return an array as the bytes of an .npy file."""
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=False)
    return stream.getvalue()


def _unpacked(data: bytes) -> NDArray[Any]:
    array: NDArray[Any] = np.load(io.BytesIO(data), allow_pickle=False)
    return array


class Recorder:
    """Writes a new sitting into a directory; UserError where it cannot be written."""

    def __init__(self, directory: Path) -> None:
        self.sitting = 1 + max(map(_number, sittings(directory)), default=0)
        self.index = 0  # The next step's number
        self.path = directory / f"sitting-{self.sitting:04d}.mcap"
        self._file, self._mcap = new_recording_at(self.path)
        self._channel = self._mcap.register_channel(TOPIC, "msgpack", 0)
        self._last: RecordedStep | None = None

    def add(self, step: RecordedStep) -> None:
        """Record a step; hold back an episode's last one until the person may have discarded it."""
        if step.terminated or step.truncated:
            self._last = step
        else:
            self.write(step)

    def end_episode(self, outcome: str | None = None) -> None:
        """Write an episode's last step, with ``outcome`` unless None; once for each episode."""
        step, self._last = self._last, None
        if step is not None:
            outcome = step.outcome if outcome is None else outcome
            self.write(msgspec.structs.replace(step, outcome=outcome))

    def write(self, step: RecordedStep) -> None:
        """Write a step, safe from a kill from then on. OSError on a full disk."""
        data, index = msgspec.msgpack.encode(step), self.index
        self.index += 1
        self._mcap.add_message(self._channel, step.time_ns, data, step.time_ns, index)
        self._mcap.flush()

    def close(self) -> None:
        """Write the index and close the file; a sitting without steps leaves none behind."""
        if self._file.closed:
            return
        self.end_episode()
        with self._file:
            self._mcap.finish()
        if self.index == 0:
            self.path.unlink()


def sittings(directory: Path) -> list[Path]:
    """Return the recordings of a directory in order; none if it does not exist."""
    paths = [path for path in directory.glob("sitting-*.mcap") if NAME.fullmatch(path.name)]
    return sorted(paths, key=_number)


def nonempty(paths: Iterable[Path]) -> list[Path]:
    """Return the files that hold anything: a power cut may leave an empty one."""
    return [path for path in paths if path.stat().st_size > MAGIC_SIZE]


def _number(path: Path) -> int:
    return int(NAME.sub(r"\1", path.name))


def find_recordings(places: Sequence[Path]) -> list[Path]:
    """Return the recordings in files, directories and runs; UserError where a place has none."""
    recordings: list[Path] = []
    for place in places:
        folders = (sittings(place), sittings(place / DIRECTORY))
        paths = [place] if place.is_file() else next(filter(None, map(nonempty, folders)), [])
        if not paths:
            raise UserError(f"no recording in {place}: expected sitting-NNNN.mcap, or such files")
        recordings += [path for path in paths if path not in recordings]
    return recordings


def read_steps(path: Path) -> Iterator[RecordedStep]:
    """Yield the steps of a recording, up to its end or to where a kill has cut it off.

    A damaged episode is left out: it lacks steps, or the end that tells whether the person
    discarded it. UserError: no such file, or not one of ours.
    """
    recording = Recording(path)
    drives = groupby(_steps(recording), key=lambda step: step.index - step.step)
    episodes = [list(drive) for _, drive in drives]
    recording.say_trouble()
    for episode in episodes:
        complete = [step.step for step in episode] == list(range(len(episode)))
        last = episode[-1]
        if complete and (last.terminated or last.truncated or episode is episodes[-1]):
            yield from episode


def _steps(recording: Recording) -> Iterator[RecordedStep]:
    """Yield every step that can be read."""
    path = recording.path
    for channel, message in recording.messages():
        if channel.topic != TOPIC:
            hint = f"`python -m bridge view {path}` shows one of the wire"
            raise UserError(f"{path}, with {channel.topic}, is no recording of a sitting; {hint}")
        try:
            yield msgspec.msgpack.decode(message.data, type=RecordedStep)
        except msgspec.DecodeError as error:  # The chunk's checksum is right, so this is no damage.
            raise UserError(f"{path} was recorded by another version: {error}") from None


def read_episodes(steps: Iterable[RecordedStep]) -> Iterator[list[RecordedStep]]:
    """Yield the steps of each episode, without episodes that the person discarded."""
    for _, drive in groupby(steps, key=lambda step: (step.sitting, step.index - step.step)):
        episode = list(drive)
        if episode[-1].outcome != DISCARDED:
            yield episode


def read_episodes_of(env: Any, path: Path) -> Iterator[list[RecordedStep]]:
    """Yield a recording's episodes, as `read_episodes` does; UserError for another task's."""
    for episode in read_episodes(read_steps(path)):
        if (scenario := episode[0].scenario) != env.scenario:
            raise UserError(f"{path} was driven in {scenario}, not in {env.scenario}")
        for step in episode:
            actions = vector(step.action), vector(step.human_action)
            check_recorded(env, path, step.observation, *actions)
        yield episode


def steps_since(directory: Path, position: tuple[int, int]) -> Iterator[RecordedStep]:
    """Yield all sittings' steps from ``position`` (sitting, index) on."""
    for path in nonempty(sittings(directory)):
        yield from (step for step in read_steps(path) if (step.sitting, step.index) >= position)
