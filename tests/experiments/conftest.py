"""Experiments are tested in the slow lane alone, most of them on one small scene."""

import dataclasses
from pathlib import Path

import pytest

import p4dgs_ref as p4


@pytest.hookimpl(tryfirst=True)  # before -m chooses
def pytest_collection_modifyitems(items):
    for item in items:
        if item.path.is_relative_to(Path(__file__).parent):
            item.add_marker(pytest.mark.slow)


@pytest.fixture(scope="session")
def scene():
    whole = p4.load_scene("bouncing", downscale=8)
    return dataclasses.replace(whole, test=whole.test[:2])
