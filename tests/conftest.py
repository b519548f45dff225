import pytest

from semstab.process import settle

pytest.register_assert_rewrite("semstab.testing")
settle()  # threads that spin would take the time of the other workers' tests
