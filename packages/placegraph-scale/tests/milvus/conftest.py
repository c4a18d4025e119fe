"""Milvus, real and not."""

from tests.vectors.conftest import *  # noqa: F403  # fixtures
