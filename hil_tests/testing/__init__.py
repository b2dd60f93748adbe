"""What the tests of all folders share: policy files, messages, drives, environments and people."""
