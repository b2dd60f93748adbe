"""Train policies with human guidance: on the command line ``python -m trainer``; in Python::

    from trainer import train, evaluate, export, load

    run = train("my_pkg:MyEnv-v0", algorithm="phil_td3", human="web", episodes=100)
    print(evaluate(run, runs=50).success_rate)
    export(run, "my.onnx", key="keys/policy.key")
    action = load("my.onnx").act(observation)

Each name is imported at its first use: torch takes two seconds to load.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from trainer.evaluation import Evaluation, evaluate, load
    from trainer.policy_file import Export, export
    from trainer.training.command import Run, train

__all__ = ["Evaluation", "Export", "Run", "evaluate", "export", "load", "train"]
_MODULES = {
    **dict.fromkeys(("Run", "train"), "trainer.training.command"),
    **dict.fromkeys(("Evaluation", "evaluate", "load"), "trainer.evaluation"),
    **dict.fromkeys(("Export", "export"), "trainer.policy_file"),
}


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return getattr(import_module(_MODULES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
