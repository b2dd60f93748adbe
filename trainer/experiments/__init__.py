"""The paper's experiments: training runs, where they are kept, how they are drawn and judged."""
