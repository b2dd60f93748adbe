"""What ``python -m trainer bench`` measures, a module for each idea."""
