"""The lowest versions that ``make test-lowest`` installs are those that setup.cfg allows."""

import configparser
import re
from pathlib import Path

import yaml
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]


def test_constraints_are_the_lower_bounds() -> None:
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    lines = config["options"]["install_requires"].splitlines()
    requirements = [Requirement(line) for line in lines if line and not line.startswith("#")]
    bounds = {r.name: next((s.version for s in r.specifier if s.operator == ">="), None) for r in requirements}
    lowest = dict(re.findall(r"^([\w-]+)==(.*)$", (ROOT / "constraints-lowest.txt").read_text(), re.MULTILINE))
    assert lowest.keys() == {name for name, bound in bounds.items() if bound}
    for name, version in lowest.items():
        assert Requirement(f"{name}=={bounds[name]}").specifier.contains(version), (name, version, bounds[name])


def test_tests_of_packages_beyond_the_extra_run_in_ci() -> None:
    """Elsewhere they are skipped."""
    skips = re.compile(r'importorskip\("ale_py"|^ +import timm$', re.MULTILINE)
    paths = sorted((ROOT / "tests").rglob("test_*.py"))
    names = [str(path.relative_to(ROOT)) for path in paths if skips.search(path.read_text(encoding="utf-8"))]
    makefile = (ROOT / "Makefile").read_text()
    assert names and f"TESTS_OF_OTHERS := {' '.join(names)}\n" in makefile
    assert "-envs/bin/python -m pytest $(TESTS_OF_OTHERS)\n" in makefile


def test_both_ends_run_in_ci() -> None:
    jobs = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text())["jobs"]
    assert jobs["test"]["strategy"]["matrix"]["target"] == ["test", "test-lowest"]
    commands = [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]
    made = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    targets = {word for command in commands if command.startswith("make ") for word in command.split()[1:]}
    words = {word for word in targets if re.fullmatch(r"[a-z-]+", word) and not word.startswith("-")}
    assert words == {"test-envs", "lint", "type"} and words | {"test", "test-lowest"} <= set(made)
    assert any(command.startswith("make ${{ matrix.target }} ") for command in commands)
