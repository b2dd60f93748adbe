"""Tables of many runs: what they compare, their records, their pages and figures."""
