"""A browser as a person's hands and eyes, for a workstation without a screen."""
