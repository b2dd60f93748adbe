"""The training loop: environment, human, learner, and the files of a run."""
