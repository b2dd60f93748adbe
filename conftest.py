import pytest

pytest.register_assert_rewrite("hil_tests.tests.shared")
pytest_plugins = ["hil_tests.tests.shared.fixtures"]  # For all tests
