"""Which commands of the wire the simulator believes; all others are counted by reason. Pure."""

from __future__ import annotations

from collections import Counter

from edge_runtime.wire import Command, Reason, Rejection, decode_command

ACTION_SIZE = "action_size"
"""Rejection reason: the policy has another number of actions than the environment."""
UNKNOWN_STEP = "unknown_step"
"""Rejection reason: the command answers a state that was never sent."""


class CommandCheck:
    """Reads commands for one simulator session and keeps the counts of the whole run.

    ``policy_ids`` holds the policies that answered, each once, in order of appearance.
    One thread at a time: the clock that owns it.
    """

    def __init__(self, session: str, action_size: int) -> None:
        self.rejected: Counter[str] = Counter()
        self.policy_ids: list[str] = []
        self._session = session
        self._action_size = action_size
        self._episode = 0
        self._newest_step = -1
        self._ended = (-1, -1)

    def begin(self, episode: int) -> None:
        """Note that an episode begins: whatever answers an earlier one is stale from now on."""
        self._episode, self._newest_step = episode, -1

    def sent(self, step: int) -> None:
        """Note that a state has been sent, so that its answer can be told from an invention."""
        self._newest_step = step

    def end(self, final_step: int, answered_step: int) -> None:
        """Note that the episode has ended, and up to which step its states were answered.

        The answers to those after it are still on their way, and come too late without a fault.
        """
        self._newest_step = final_step
        self._ended = (self._episode, answered_step)

    def read(self, payload: bytes) -> Command | None:
        """Return the command if it answers a state of this episode; None otherwise.

        An answer that the end of its episode overtook is None, too, but is not counted.
        """
        command = decode_command(payload)
        if isinstance(command, Rejection):
            self.reject(command.reason.value)
            return None
        fault = self._fault(command)
        if fault:
            self.reject(fault)
            return None
        if self._overtaken(command):
            return None
        if command.policy_id not in self.policy_ids:
            self.policy_ids.append(command.policy_id)
        return command

    def reject(self, reason: str) -> None:
        """Count one rejected command."""
        self.rejected[reason] += 1

    def _fault(self, command: Command) -> str:
        """Why a well-formed command answers nothing in this episode; empty if it does."""
        if command.session != self._session:
            return Reason.FOREIGN_SESSION.value
        if len(command.action) != self._action_size:
            return ACTION_SIZE
        if (command.episode, command.step) > (self._episode, self._newest_step):
            return UNKNOWN_STEP
        if command.episode < self._episode and not self._overtaken(command):
            return Reason.STALE.value
        return ""

    def _overtaken(self, command: Command) -> bool:
        ended_episode, answered_step = self._ended
        return command.episode == ended_episode and command.step > answered_step
