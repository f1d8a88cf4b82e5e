"""The lowest versions that ``make test-lowest`` installs are those that setup.cfg allows."""

import configparser
import re
from pathlib import Path

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
