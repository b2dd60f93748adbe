"""Long proofs of the installer: each a command with a JSON result."""
