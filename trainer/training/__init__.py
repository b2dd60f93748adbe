"""The training loop: environment, human, learner, and what is kept of a run."""
