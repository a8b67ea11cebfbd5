"""How all tests run: shapes checked (jaxtyping, enforced by beartype), on one thread, the long ones on request."""

import logging
import os
from collections.abc import Iterator

import pytest
import torch
from jaxtyping import install_import_hook

install_import_hook("tidefield", "beartype.beartype")

torch.set_num_threads(1)


@pytest.fixture(autouse=True, scope="module")
def messages_as_before() -> Iterator[None]:
    """Commands set up logging and threads for their whole process, which here is that of all tests."""
    ours, root, environment = logging.getLogger("tidefield"), logging.getLogger(), dict(os.environ)
    level, handlers = ours.level, root.handlers[:]
    yield
    ours.setLevel(level)
    root.handlers[:] = handlers
    os.environ.clear()
    os.environ.update(environment)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--thorough", action="store_true", help="run the tests that take several seconds each, too")
    parser.addoption("--slow", action="store_true", help="run these and the tests that take more than a minute")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Skip, and say so, what was not asked for and what this machine cannot run."""
    skips = {}
    if not config.getoption("--slow"):
        skips["slow"] = pytest.mark.skip(reason="takes more than a minute; run with --slow")
        if not config.getoption("--thorough"):
            skips["thorough"] = pytest.mark.skip(reason="takes several seconds; run with --thorough")
    if not torch.cuda.is_available():
        skips["gpu"] = pytest.mark.skip(reason="needs a CUDA device, and there is none")
    for item in items:
        for marker, skip in skips.items():
            if item.get_closest_marker(marker) is not None:
                item.add_marker(skip)
