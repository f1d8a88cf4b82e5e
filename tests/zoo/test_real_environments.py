"""The three commands on environments of other packages, as far as these are installed: `make test-envs`."""

from pathlib import Path

import pytest

from benchmarks.any_pixels import ALGORITHMS, CASES, Case, is_right, run_case

# What registers an environment without a package to name.
NEEDS = {"CarRacing-v3": "Box2D", "LunarLander-v3": "Box2D", "BipedalWalker-v3": "Box2D"}


def _need(case: Case) -> None:
    pytest.importorskip(case.package or NEEDS.get(case.env_id, "pygame"))


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.env_id}-{case.stack}")
def test_the_three_commands(case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _need(case)
    monkeypatch.setenv("MUJOCO_GL", "egl")
    outcome = run_case(case, tmp_path)
    assert outcome is not None and is_right(case, outcome), outcome


@pytest.mark.slow
@pytest.mark.parametrize(("case", "algos"), ALGORITHMS, ids=lambda one: one.env_id if isinstance(one, Case) else "")
def test_algorithms(case: Case, algos: tuple[str, ...], tmp_path: Path) -> None:
    _need(case)
    outcome = run_case(case, tmp_path, algos)
    # 2 is a refusal: rl-zoo3 has no entry of that algorithm for the id.
    assert outcome is not None and all(outcome[algo]["code"] in (0, 2) for algo in algos), outcome


def test_twenty_environments_that_nothing_here_names() -> None:
    package = Path(__file__).parents[2] / "sb3_abisim"
    source = "\n".join(path.read_text(encoding="utf-8") for path in package.rglob("*.py"))
    assert len({case.env_id for case in CASES if f'"{case.env_id}"' not in source}) >= 20
    assert len({algo for _, algos in ALGORITHMS for algo in algos}) == 9 and len(ALGORITHMS) == 3
