"""Runs, and the report of them, that the tests of its page and of its tables share."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from benchmark_inputs import write_all

from sb3_abisim.benchmark.report import statistics
from sb3_abisim.benchmark.report.page import report


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_all(tmp_path_factory.mktemp("runs"))


@pytest.fixture(scope="module")
def few_resamples() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(statistics, "N_RESAMPLES", 50)  # rliable is slow
        yield


@pytest.fixture(scope="module")
def made(few_resamples: None, logs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return report([str(logs)], tmp_path_factory.mktemp("report")).parent
