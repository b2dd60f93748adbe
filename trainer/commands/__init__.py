"""The commands of ``python -m trainer``, one module each."""

from types import ModuleType

from trainer.commands import (
    bench,
    drive,
    evaluate,
    experiment,
    export,
    human,
    picture,
    plot,
    train,
    view,
)

COMMANDS: dict[str, ModuleType] = {
    "train": train,
    "drive": drive,
    "human": human,
    "evaluate": evaluate,
    "export": export,
    "plot": plot,
    "picture": picture,
    "view": view,
    "bench": bench,
    "experiment": experiment,
}
"""Name -> module with ``add_arguments(parser)``, ``run(arguments)`` and ``EXAMPLE``."""
