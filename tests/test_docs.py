"""The pages of docs/ as a site."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    # Strict: a link that leads nowhere, or a module that is not there, is an error.
    words = ["mkdocs", "build", "--strict", "-d", str(folder)]
    done = subprocess.run([sys.executable, "-m", *words], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder


def test_links_out_of_the_docs_lead_into_the_site(site):
    for page, link in (
        ("index.html", "differences/"),
        ("index.html", "repository/encoders/"),
        ("pretraining/index.html", "../repository/benchmarks/results/memory/"),
        ("scan_nav/index.html", "../repository/benchmarks/results/scan_learning.json"),
        ("objectives/ssi/index.html", "../../repository/encoders/"),
    ):
        assert f'href="{link}"' in (site / page).read_text(), (page, link)
        assert ((site / page).parent / link).exists(), (page, link)
    assert (site / "images" / "environments.png").is_file()


def test_the_reference_knows_parameters_and_no_roles_are_left(site):
    html = (site / "api" / "index.html").read_text()
    text = re.sub(r"<[^>]+>", "", html)
    assert 'id="sb3_abisim.rl.extractors.PretrainedExtractor"' in html
    assert "name of a shipped one such as" in text, "the description of PretrainedExtractor's parameter encoder"
    assert not re.search(r":(class|meth|func|mod|data):", text)
