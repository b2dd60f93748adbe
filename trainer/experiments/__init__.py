"""The paper's experiments: what is trained, the kept records, its claims, figures and report."""
