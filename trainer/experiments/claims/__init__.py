"""What the paper says about each figure and table, held against what was gathered."""
