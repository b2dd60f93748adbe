"""What can drive and what is driven: actions, test conditions, experts, and policies by name.

A name is the word expert, ``constant:ACTION``, an exported policy, a training run or a human model.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch

from edge_runtime.policy import Action as ActionEntry
from edge_runtime.util import UserError
from trainer.human.congestion import CongestionExpert, CongestionTrigger
from trainer.human.guide import Action, Driver, Observation, Trigger
from trainer.human.left_turn import LeftTurnExpert, LeftTurnTrigger
from trainer.human.model import MODEL_FILE, load_human_model
from trainer.learner.networks import Actor
from trainer.scenarios import SCENARIOS
from trainer.scenarios.congestion import CongestionConfig
from trainer.scenarios.environment import Scene
from trainer.util import load_torch

ACTIONS = {
    "left_turn": ActionEntry(
        name="pedal",
        meaning="positive opens the throttle, negative brakes",
        unit="aperture",
        low=-1.0,
        high=1.0,
    ),
    "congestion": ActionEntry(
        name="steering",
        meaning="positive turns right, negative left (eq. 29)",
        unit=f"share of the front wheels' {CongestionConfig().lambda_rad:g} rad",
        low=-1.0,
        high=1.0,
    ),
}
"""Scenario -> what its action means to a vehicle."""
COMMAND_NOISE = 0.05 * 2.0
"""Standard deviation of the noise condition: 5 % of the whole control domain (section VII-D)."""
CONSTANT = "constant:"
"""Before an action that is kept throughout: what any policy should be better than."""
CHECKPOINT_FILE = "checkpoint.pt"
BEST_FILE = "best_actor.pt"
EXPERTS: dict[str, Callable[[Any], Driver]] = {
    "left_turn": LeftTurnExpert,
    "congestion": CongestionExpert,
}
"""Scenario -> its scripted expert, made from the environment."""
TRIGGERS: dict[str, Callable[[Any], Trigger]] = {
    "left_turn": LeftTurnTrigger,
    "congestion": CongestionTrigger,
}
"""Scenario -> when a person would take over, made from that expert."""


ActTogether = Callable[[Observation], Action]
"""Many actions for many observations."""


class Condition(NamedTuple):
    """How test episodes are driven."""

    scene: Scene
    noise_std: float
    """Standard deviation of the Gaussian noise on the command."""
    meaning: str


CONDITIONS = {
    "nominal": Condition("nominal", 0.0, "the scene that is trained in"),
    "noise": Condition(
        "nominal", COMMAND_NOISE, "Gaussian noise of 5 % of the control domain on the command"
    ),
    "variant": Condition("variant", 0.0, "more vehicles, and other types of them"),
    "dense": Condition("dense", 0.0, "closer and less even traffic"),
}
"""Only the first is trained and validated in."""


class TogetherDriver(Driver):
    """Drives without a memory, one picture at a time or many at once.

    ``act_together`` gives actions float32 [n, action size] for observations [n, 2, 45, 80].
    """

    def __init__(self, act_together: ActTogether) -> None:
        self.act_together = act_together

    def act(self, observation: Observation) -> Action:
        """The action, float32 [action size]."""
        return self.act_together(observation[None])[0]


def network_driver(actor: Actor) -> TogetherDriver:
    """A policy network that drives: pi(s)."""
    device = next(actor.eval().parameters()).device

    @torch.no_grad()
    def act_together(observations: Observation) -> Action:
        actions: Action = actor(torch.from_numpy(observations).to(device)).cpu().numpy()
        return actions

    return TogetherDriver(act_together)


def constant_driver(action: float) -> TogetherDriver:
    """One action throughout, whatever the picture; ValueError unless it is from -1 to 1."""
    if not -1.0 <= action <= 1.0:
        raise ValueError(action)
    return TogetherDriver(lambda seen: np.full((len(seen), 1), action, np.float32))


class OnnxDriver(Driver):
    """An exported policy file that drives, run by the edge runtime's own loader."""

    def __init__(self, path: Path, public_key: str | None = None) -> None:
        from edge_runtime.policy import load_policy

        self.policy = load_policy(str(path), public_key, allow_unsigned=True)

    def act(self, observation: Observation) -> Action:
        """The policy's action, float32 [action size], within its domain as the edge sends it.

        onnxruntime's tanh exceeds 1 by a last bit now and then.
        """
        return np.clip(self.policy.act(observation), -1.0, 1.0)


def make_environment(
    scenario: str, condition: str = "nominal", printed_reward: bool = False
) -> Any:
    """The scenario's environment, without wrappers, in the scene of a test condition.

    With ``printed_reward`` it pays what eq. 31 or 32 says, without the scenario's weight.

    Raises:
        UserError: no such scenario.
    """
    if scenario not in SCENARIOS:
        raise UserError(f"unknown scenario {scenario!r}; there is {', '.join(SCENARIOS)}")
    scene = CONDITIONS[condition].scene
    env: Any = gymnasium.make(SCENARIOS[scenario], scene=scene).unwrapped
    if printed_reward:
        env.config = env.config.with_printed_reward()
    return env


def load_driver(policy: str, env: Any, public_key: str | None = None) -> tuple[Driver, str]:
    """The driver that the word or path ``policy`` names, and its policy id.

    ``public_key`` is a PEM file to verify an .onnx file with; see `edge_runtime.policy`.

    Raises:
        UserError: nothing there that drives.
    """
    if policy == "expert":
        return EXPERTS[env.scenario](env), "expert"
    if policy.startswith(CONSTANT):
        try:
            return constant_driver(float(policy.removeprefix(CONSTANT))), policy
        except ValueError:
            message = f"{policy}: expected an action from -1 to 1, as in {CONSTANT}0.5"
            raise UserError(message) from None
    path = Path(policy)
    if path.suffix == ".onnx":
        driver, wanted = OnnxDriver(path, public_key), ACTIONS[env.scenario].name
        names = [action.name for action in driver.policy.manifest.action]
        if names != [wanted]:
            raise UserError(
                f"{policy} answers with {', '.join(names)}, and {env.scenario} asks for {wanted}"
            )
        return driver, driver.policy.policy_id
    if (path / MODEL_FILE).is_file():
        actor, about = load_human_model(path)
        policy_id = f"human:{path.name}"
    elif path.is_dir():
        actor, about = load_actor(path)
        policy_id = f"run:{path.name}:{about['episode']}"
    else:
        raise UserError(
            f"{policy} is no policy: expected an .onnx file, a training run, "
            "a human model's directory, the word expert, or constant:ACTION"
        )
    if about["scenario"] != env.scenario:
        raise UserError(f"{policy} was trained in {about['scenario']}, not in {env.scenario}")
    return network_driver(actor), policy_id


def load_actor(run_dir: Path) -> tuple[Actor, dict[str, Any]]:
    """A run's actor: the best on the validation seeds, or the last one where none was validated.

    Returns:
        The network, and a dict with ``scenario``, ``algorithm``, ``seed``, ``episode``.
    """
    for name in (BEST_FILE, CHECKPOINT_FILE):
        if (run_dir / name).is_file():
            return _read_actor(run_dir / name)
    raise UserError(f"{run_dir} holds no training run ({BEST_FILE} or {CHECKPOINT_FILE})")


def _read_actor(path: Path) -> tuple[Actor, dict[str, Any]]:
    state = load_torch(path)
    try:
        networks = state if path.name == BEST_FILE else state["learning"]["learner"]
        weights = networks[state.get("kept_actor", "actor")]
        frames = weights["picture.trunk.conv1.weight"].shape[1]
        actor = Actor(len(weights["head.output.bias"]), frames)
        actor.load_state_dict(weights)
        label = {key: state[key] for key in ("scenario", "algorithm", "seed", "episode")}
    except (KeyError, TypeError, AttributeError, IndexError, RuntimeError) as error:
        raise UserError(f"{path} is not a checkpoint of this project") from error
    return actor, label
