"""Settings that every test shares: reproducible draws, no display, no wall-clock deadlines."""

from __future__ import annotations

import os

import pytest
import torch
from hypothesis import settings

os.environ.setdefault("MPLBACKEND", "Agg")

# Failures must reproduce on any machine: no deadline, no stored examples, the same draws each run.
settings.register_profile("repository", deadline=None, derandomize=True, database=None)
settings.load_profile("repository")


@pytest.fixture(autouse=True)
def _fixed_seed() -> None:
    """Makes each test independent of the tests that ran before it."""
    torch.manual_seed(0)
