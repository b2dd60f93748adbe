"""Settings of the human model's training."""

from dataclasses import dataclass, fields

from trainer.util import FROM_ONE, check_ranges

MODEL_FILE = "human_model.pt"
RANGES = {(1, 2): ("frames",), FROM_ONE: ("batch_size", "episodes", "updates_per_episode")}
"""Ranges of these numbers; all others are at least 0."""


@dataclass(frozen=True)
class HumanModelConfig:
    """Settings of tables A4 and A7, and those that the paper leaves open."""

    frames: int = 1
    """Frames that the model sees (table A4: one). Two show speed: in the left turn the model then
    drives about 20.5 m instead of 18.4 to 20.2. The congestion needs only one."""
    learning_rate: float = 1e-4
    """Table A7."""
    batch_size: int = 128
    """Table A7."""
    episodes: int = 50
    """Maximum number of episodes (table A7)."""
    updates_per_episode: int = 60
    """Gradient steps after each episode. Not in the paper."""
    demonstrate_every: int = 2
    """The person drives one whole episode in this many, from the second on; 0: never.
    Interventions alone, the paper's only source, show little of ordinary good driving."""
    label_every_step: bool = False
    """At every step that the model drives, also learn the scripted expert's action, which a person
    could not give (DAgger as of Ross et al. 2011). Interventions alone do not correct
    small errors, such as standing too far from the line."""
    refining_updates: int = 0
    """Gradient steps after the last episode, with a learning rate that falls to zero. Not in the
    paper. On few examples 2,000 made no difference; on 22,000 examples 12,000 brought the left
    turn's loss from 0.15 to 0.05."""

    def __post_init__(self) -> None:
        check_ranges(self, RANGES)


FIXED = ("learning_rate", "batch_size")
FIELDS = [field.name for field in fields(HumanModelConfig) if field.name not in FIXED]
"""Fields with an option of their own."""
