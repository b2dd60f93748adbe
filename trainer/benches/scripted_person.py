"""The trainer with a person who is a program, in a process that may be killed.

``python -m trainer.benches.scripted_person SEEN COMMAND ...`` is ``python -m trainer COMMAND ...``
with one more ``--human scripted``: hands that take over and give back by themselves, and eyes that
note in the file SEEN which step they have seen last, so that whoever kills the process knows.
"""

from __future__ import annotations

import math
import mmap
import struct
import sys
from pathlib import Path

from edge_runtime.cli import run_cli
from trainer.__main__ import main as trainer
from trainer.person.interface import HUMANS, Person, PersonOptions, Reading, View

NOTE = struct.Struct("<Q")
HOLD, REST = 12, 8
"""Control periods in control, and out of it."""


class ScriptedPerson:
    """Device and display.

    Args:
        seen: where the eyes note what they see.
    """

    help = ("a program drives",)
    present = True

    def __init__(self, seen: Path) -> None:
        with seen.open("r+b") as file:
            self._note = mmap.mmap(file.fileno(), NOTE.size)
        self._periods = 0

    def poll(self, now_s: float) -> Reading:
        """A slow wave, held for a while and let go for a while."""
        self._periods += 1
        engaged = self._periods % (HOLD + REST) < HOLD
        return Reading(math.sin(0.2 * self._periods) if engaged else 0.0, engaged)

    def show(self, view: View) -> None:
        """Note the episode, and how many of its steps have been taken."""
        NOTE.pack_into(self._note, 0, view.episode << 32 | view.step)

    def close(self) -> None:
        """Nothing to let go of."""


def last_seen(seen: Path) -> tuple[int, int]:
    """Episode, and how many of its steps were taken when the eyes looked last."""
    (note,) = NOTE.unpack(seen.read_bytes())
    return note >> 32, note & 0xFFFFFFFF


def main(argv: list[str]) -> int:
    """Run the trainer's command with the person added."""
    seen = Path(argv[0])

    def scripted(options: PersonOptions) -> Person:
        person = ScriptedPerson(seen)
        return Person(person, person)

    HUMANS["scripted"] = scripted
    return trainer(argv[1:])


if __name__ == "__main__":
    sys.exit(run_cli(main))
