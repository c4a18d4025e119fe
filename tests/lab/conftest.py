"""Fixtures of the library's own tests that the lab needs as well."""

from tests.indoor.conftest import *  # noqa: F403  # fixtures
