"""``python -m trainer``: train, evaluate, export, and all else that a learner needs."""

import sys

from edge_runtime.cli import program, run_cli

COMMANDS: dict[str, tuple[str, str]] = {
    "train": ("trainer.training.command", "train a policy with human guidance"),
    "drive": ("trainer.person.session", "drive yourself, or take over from a policy; recorded"),
    "human": ("trainer.human.dagger", "train the human model from interventions (DAgger)"),
    "evaluate": ("trainer.evaluation", "drive test episodes and report how well it does"),
    "export": ("trainer.policy_file", "write a run's actor as the file that a board drives"),
    "plot": ("trainer.pictures:PLOT", "draw the learning curve of a run"),
    "view": ("trainer.view", "show recorded sittings in rerun"),
    "bench": ("trainer.bench", "measure learner, environments and training beside peers"),
    "experiment": ("trainer.experiments.command", "run the paper's experiments, judge its claims"),
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
