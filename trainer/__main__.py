"""``python -m trainer``: train, evaluate, export, and all else that a learner needs."""

import sys

from edge_runtime.cli import program, run_cli

COMMANDS: dict[str, tuple[str, str]] = {
    "train": ("trainer.commands:train", "train a policy with human guidance"),
    "drive": ("trainer.commands:drive", "drive yourself, or take over from a policy; recorded"),
    "human": ("trainer.commands:human", "train the human model from interventions (DAgger)"),
    "evaluate": ("trainer.commands:evaluate", "drive test episodes and report how well it does"),
    "export": ("trainer.commands:export", "write a run's actor as the file that a board drives"),
    "plot": ("trainer.commands:plot", "draw the learning curve of a run"),
    "view": ("trainer.commands:view", "show recorded sittings in rerun"),
    "bench": ("trainer.commands:bench", "measure learner, environments and training beside peers"),
    "experiment": ("trainer.commands:experiment", "run the paper's experiments or another table"),
}


main = program(
    "python -m trainer",
    "Trains driving policies with human guidance, evaluates and exports them.",
    COMMANDS,
    "python -m trainer train --scenario left_turn --episodes 120 --out runs/phil_1",
    "python -m trainer evaluate runs/phil_1 --runs 50",
)

if __name__ == "__main__":
    sys.exit(run_cli(main))
