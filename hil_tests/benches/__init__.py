"""What ``make bench-loop`` measures, a module for each idea."""
