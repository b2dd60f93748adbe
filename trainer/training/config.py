"""The settings that decide a training run's result, from options, files and presets."""

import difflib
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from bridge.network import parse_spec
from edge_runtime.manifest import MAX_PERIOD_S, MIN_PERIOD_S
from edge_runtime.util import UserError
from trainer.learner.config import PRINTED_LEARNER, LearnerConfig, find_algorithm, task_settings
from trainer.util import FROM_ONE, SHARE, check_ranges

MOST_THREADS = 1024
"""More than any machine can use. Torch crashes if the system cannot start the threads."""
RANGES = {
    FROM_ONE: ("episodes", "evaluation_runs", "checkpoint_every"),
    SHARE: ("guided_share", "poor_guidance_share", "missed_share"),
    (0, 2**63 - 1): ("seed",),
    (0, MOST_THREADS): ("threads",),
    (MIN_PERIOD_S, MAX_PERIOD_S): ("period_s",),
}
"""Ranges of these numbers; all others are at least 0."""
UNLIMITED_EPISODES = 10**6  # So many that the budget of steps ends a training
CURVE_FILE = "learning_curve.png"
EXTENT = ("episodes", "steps")  # Length of a run; a resumed run may raise it
OPTIONS = (
    "scenario", "algorithm", "seed", "human", "latency", "device", "threads", "demonstrations",
    "success",
)  # fmt: skip
"""Settings with an option of their own; ``--set`` changes all others."""
TYPED = (*OPTIONS, *EXTENT, "preset")
CONFIG_FILE = "config.json"  # A run's settings in its directory, with the source's revision
RANDOM, BIASED, TAKEOVERS = GUIDANCE = ("random", "biased", "takeovers")
"""A poor human's wrong actions: drawn each time, always the same, or the same for whole
take-overs."""


@dataclass(frozen=True)
class RunConfig:
    """Settings of a run. The same settings on the same machine give the same weights, as long as
    the compiled kernel is used in both runs or in neither.
    """

    scenario: str = "left_turn"
    algorithm: str = "phil_td3"
    """Learning algorithm: phil_td3, ia_td3, hi_td3, rd2_td3, rd2_phil, per_td3, another row of
    trainer/learner/config.py, one of an installed package, or ``MODULE:ROW``."""
    seed: int = 0
    episodes: int = 400
    """Maximum number of training episodes (table A5: 400); no limit if only ``steps`` is given."""
    steps: int = 0
    """Stop after this many environment steps, at the end of the running episode; 0: no limit."""
    human: str = "expert"
    """Who takes over from the policy: the environment's scripted expert, your own expert as
    ``MODULE:CLASS``, a model trained by `trainer human`, or you, in the browser (web). A run's own
    config then says ``person``."""
    guided_share: float = 1.0
    """Share of the episodes in which the human watches (the authors' code: a third in the left
    turn)."""
    guided_until_episode: int = 0
    """Episodes after which the human no longer watches; 0: no end."""
    late_from_s: float = 0.0
    """Minimum take-over delay, s; the delay of each take-over is drawn at random."""
    late_to_s: float = 0.0
    """Maximum take-over delay, s."""
    missed_share: float = 0.0
    """Share of the reasons to take over that the human overlooks, each for 15 control periods."""
    averaged_actor: bool = True
    """Whether the target actor is validated, kept and exported, instead of the actor that learns.
    The learning actor oscillates; the target is its running average (Polyak and Juditsky, 1992)."""
    poor_guidance_share: float = 0.0
    """Share of the human's actions, or take-overs, replaced by wrong ones (section VII-E: one
    third)."""
    poor_guidance: str = RANDOM
    """The wrong actions: ``random`` (the paper's), ``biased`` (always the same one), or
    ``takeovers`` (that one through whole take-overs)."""
    period_s: float = 0.0
    """Control period, s; 0: the environment's own."""
    printed_reward: bool = False
    """Weight 1 on the term of eq. 31 or 32, as the equations are printed, instead of the scenario's
    own (``LeftTurnConfig.speed_weight``, ``CongestionConfig.steer_weight``)."""
    evaluate_every_steps: int = 500
    """Environment steps between two validations; 0: no validation."""
    evaluation_runs: int = 30
    """Episodes of a validation."""
    confirmation_factor: int = 2
    """An actor is kept only after driving this many times a validation's episodes, on other seeds;
    0: at once. The best of many validations overestimates its actor."""
    checkpoint_every: int = 10
    """Episodes between two checkpoints."""
    latency: str = "none"
    """Simulated network between policy and vehicle, in training and validation, written as for
    ``bridge simulate --latency``."""
    device: str = "cpu"
    threads: int = 0
    """Processor threads of the learner; 0: PyTorch's default. Another number sums in another order,
    and gives other weights."""
    demonstrations: str = ""
    """Drives to learn from before the first step: a person's recordings, F.mcap of bridge record,
    a LeRobot data set, or ``human:N``, N drives of the scripted human. Their seconds count as the
    human's."""
    success: str = ""
    """Function that decides whether an episode succeeded, where the environment does not. It takes
    the last observation, its info and the return; it returns True, False or None."""
    learner: LearnerConfig = field(default_factory=LearnerConfig)

    def __post_init__(self) -> None:
        check_ranges(self, RANGES)
        if self.poor_guidance not in GUIDANCE:
            known = ", ".join(GUIDANCE)
            raise UserError(f"poor_guidance must be one of {known}: {self.poor_guidance}")
        if self.late_to_s < self.late_from_s:
            raise UserError(f"late_to_s {self.late_to_s} is below late_from_s {self.late_from_s}")

    def guided(self, episode: int) -> bool:
        """Whether the human watches an episode, counted from 0."""
        if self.guided_until_episode and episode >= self.guided_until_episode:
            return False
        return math.ceil((episode + 1) * self.guided_share) > math.ceil(episode * self.guided_share)

    @property
    def kept_actor(self) -> str:
        """Name of the learner's network that is validated and kept."""
        return "target_actor" if self.averaged_actor else "actor"

    def label(self, episode: int) -> dict[str, Any]:
        """Return the fields with which a file of the run names run and episode."""
        names = ("scenario", "algorithm", "seed")
        return {**{name: getattr(self, name) for name in names}, "episode": episode}


PRINTED = RunConfig(averaged_actor=False, printed_reward=True, learner=PRINTED_LEARNER)
"""The paper's printed settings, except that freeing a stuck car is not penalised (eq. 17), and eq.
21b's exponent has a bound. Where the paper is ambiguous: table A5's noise scale of 0.2 is that of
TD3's target smoothing, which eq. 22 does not show; its rates of 1 and 0.05 are deviations of the
exploration noise (eq. 18b); eq. 32 counts steering in units of full action. Where it says nothing,
ours apply: cloning weight, precision, 256 steps before the first update, the best actor kept."""
PRESETS = {"ours": RunConfig(), "printed": PRINTED}
"""Settings to start from, by the word behind ``--preset``."""
DEFAULTS = RunConfig()
SETTINGS: dict[str, Any] = {
    **{n: v for n, v in asdict(DEFAULTS).items() if n not in (*OPTIONS, *EXTENT, "learner")},
    **asdict(DEFAULTS.learner),
}
"""Every setting that ``--set`` may change, with its default."""
EXPECTED = {bool: "true or false", int: "a whole number", float: "a number"}


def make_config(preset: str, values: Mapping[str, Any], env: Any = None) -> RunConfig:
    """Make a config: a preset, changed by the environment's defaults, by the algorithm's own
    settings, and last by ``values``, name to value.

    Raises UserError: no such preset or algorithm, or a value out of range.
    """
    if preset not in PRESETS:
        raise UserError(f"preset must be one of {', '.join(PRESETS)}: {preset}")
    start, values = PRESETS[preset], dict(values)
    values["latency"] = str(parse_spec(values.get("latency", start.latency)))
    if values.get("episodes") is None:
        values["episodes"] = UNLIMITED_EPISODES if values.get("steps") else start.episodes
    algorithm = values.get("algorithm", start.algorithm)
    row, of_task = find_algorithm(algorithm), {}
    if env is not None and preset == "ours":
        from trainer.learner.networks import sees_picture  # torch takes two seconds to load

        of_task = task_settings(row, not sees_picture(env.observation_space), env.control_period_s)
    try:
        learner = replace(start.learner, **{**of_task, **row.settings})
    except TypeError as error:  # The row is a plug-in's.
        raise UserError(f"settings of {algorithm}: {error}") from None
    own = {name: values.pop(name) for name in tuple(values) if hasattr(learner, name)}
    # At once: some values are valid only together.
    return replace(start, **values, learner=replace(learner, **own))


def parse_setting(assignment: str) -> tuple[str, Any]:
    """Return the name and the value of one NAME=VALUE.

    Raises UserError: no such setting, or no such value of it.
    """
    name, equals, text = assignment.partition("=")
    if not equals:
        raise UserError(f"--set {assignment}: expected NAME=VALUE")
    if name not in SETTINGS:
        near = difflib.get_close_matches(name, SETTINGS, 1)
        guess = f"did you mean {near[0]}?" if near else "--set alone lists them"
        raise UserError(f"--set {assignment}: there is no setting {name!r}; {guess}")
    kind = type(SETTINGS[name])
    try:
        value: Any = {"true": True, "false": False}[text.lower()] if kind is bool else kind(text)
    except (ValueError, KeyError):
        raise UserError(f"--set {assignment}: expected {EXPECTED[kind]}, got {text!r}") from None
    return name, value


def flat(config: RunConfig) -> dict[str, Any]:
    """Return all settings, those of the learner among them."""
    values = asdict(config)
    return values | values.pop("learner")


def settings_in(values: Mapping[str, Any], place: str) -> dict[str, Any]:
    """Return the settings in a file by name, those of the learner among them.

    Settings that no longer exist are left out. UserError for a value of the wrong type.
    """
    learner = values.get("learner", {})
    if not isinstance(learner, dict):
        raise UserError(f"config {place}: learner cannot be {learner!r}")
    settings: dict[str, Any] = {}
    for name, value in {**values, **learner}.items():
        if name in SETTINGS:
            settings[name] = parse_setting(f"{name}={value}")[1]
        elif name in (*OPTIONS, *EXTENT):
            if type(value) is not type(getattr(DEFAULTS, name)):
                raise UserError(f"config {place}: {name} cannot be {value!r}")
            settings[name] = value
    return settings


def period_of(config: Mapping[str, Any]) -> float | None:
    """Return the control period of a saved run, s; None for the environment's own."""
    period_s = config.get("period_s", 0.0)
    if not isinstance(period_s, int | float):
        raise UserError(f"period_s of the run's config is no number: {period_s!r}")
    return period_s or None
