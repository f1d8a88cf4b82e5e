"""The pages: their links in the repository, and the site that Sphinx makes of them."""

import re
import subprocess
import sys
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

import sb3_abisim
from sb3_abisim.registry import Method, methods
from tools.make_environments_page import page as environments_page

ROOT = Path(__file__).resolve().parent.parent
LISTED = ["git", "ls-files", "-co", "--exclude-standard"]
PAGES = sorted(
    name
    for name in subprocess.run([*LISTED, "*.md"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    if (ROOT / name).is_file()
)
CODE = re.compile(r"^(```|:::|~~~).*?^\1|``.*?``|`[^`\n]*`|^ {4}.*?$", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"\]\(([^)\s]+)\)|(?:src|href)=\"([^\"]+)\"")
# What Markdown's and reStructuredText's signs look like where they were not understood.
RAW = re.compile(r"```|:::|\]\(|\{[a-z-]+\}`|:(?:class|meth|func|mod|data|obj|ref):|^\s*(?:#{2,} |\|-)", re.MULTILINE)


def anchors(text: str) -> set[str]:
    """Of a page's headings, as the repository's web view names them."""
    seen: Counter[str] = Counter()
    found = set()
    for title in re.findall(r"^#{1,6} +(.+?)\s*$", re.sub(r"^```.*?^```", "", text, flags=re.S | re.M), re.MULTILINE):
        title = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", title)
        slug = re.sub(r"[^\w\- ]", "", title.lower()).strip().replace(" ", "-")
        found.add(f"{slug}-{seen[slug]}" if seen[slug] else slug)
        seen[slug] += 1
    return found


@pytest.mark.parametrize("page", PAGES)
def test_links_of_a_page_lead_somewhere_in_the_repository(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    for groups in LINK.findall(CODE.sub("", text)):
        link = urlsplit(groups[0] or groups[1])
        if link.scheme or link.netloc:
            continue
        target = ((ROOT / page).parent / unquote(link.path)).resolve() if link.path else ROOT / page
        assert target.is_relative_to(ROOT) and target.is_file(), f"{page}: {link.geturl()}"
        if link.fragment:
            assert link.fragment in anchors(target.read_text(encoding="utf-8")), f"{page}: {link.geturl()}"


@pytest.mark.parametrize("name", [name for name, method in methods().items() if not method.trained_elsewhere])
def test_every_method_has_a_page_with_idea_equation_code_command_and_numbers(name: str) -> None:
    page = (ROOT / "docs" / "objectives" / f"{name}.md").read_text(encoding="utf-8")
    parts = ["**What.**", "**Equation", "**Source.**", "**Run.**", "**Numbers.**"]
    places = [page.find(part) for part in parts]
    assert -1 not in places and places == sorted(places), dict(zip(parts, places, strict=True))
    command = page[places[3] : places[4]]
    assert re.search(rf"^    sb3-abisim train .*--conf-file {name}\b", command, re.MULTILINE), command
    assert re.search(r"<!-- table\n.*?-->\n\n\|", page[places[4] :], re.DOTALL), "a table of benchmarks.results_page"
    for index in ("README.md", "docs/objectives/README.md"):
        link = f"{'docs/objectives/' if index == 'README.md' else ''}{name}.md"
        assert f"]({link})" in (ROOT / index).read_text(encoding="utf-8"), index


@pytest.mark.parametrize("method", list(methods().values()), ids=lambda method: method.name)
def test_the_pages_on_extractors_and_on_the_zoo_name_every_method(method: Method) -> None:
    assert f"`{method.extractor}`" in (ROOT / "docs" / "encoders.md").read_text(encoding="utf-8")
    if not method.trained_elsewhere:
        zoo = (
            (ROOT / "docs" / "zoo.md")
            .read_text(encoding="utf-8")
            .partition("| `--conf-file` |")[2]
            .partition("\n\n")[0]
        )
        assert re.search(rf"^\|.*`{method.name}`", zoo, re.MULTILINE)


def test_the_page_of_environments_says_what_they_and_the_results_say() -> None:
    made = environments_page()
    assert made == (ROOT / "docs" / "environments.md").read_text(encoding="utf-8"), "tools/make_environments_page.py"


def build(folder: Path) -> Path:
    """Make the site, a warning being an error."""
    words = ["-b", "html", "-q", "-W", "--keep-going", "-c", "docs", "-d", str(folder / "doctrees")]
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", *words, ".", str(folder / "html")], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return folder / "html"


class Page(HTMLParser):
    """What a built page names and shows."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.ids: set[str] = set()
        self.links: list[str] = []
        self.images: list[str] = []
        self.headings: list[str] = []
        self.prose = ""
        self._open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.ids.add(given.get("id", ""))
        if "href" in given and tag == "a":
            self.links.append(given["href"])
        if tag == "img":
            self.images.append(given["src"])
        if tag == "h1":
            self.headings.append("")
        if tag in ("pre", "code", "script", "style", "h1"):
            self._open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if self._open and self._open[-1] == tag:
            self._open.pop()

    def handle_data(self, data: str) -> None:
        if "h1" in self._open:
            self.headings[-1] += data
        if not self._open:
            self.prose += data


def test_the_site(tmp_path: Path) -> None:
    # One test: processes that run tests in parallel would each build it again.
    site = build(tmp_path)
    built = {path: Page(path.read_text(encoding="utf-8")) for path in sorted(site.rglob("*.html"))}
    every_page_is_built_with_one_heading_and_nothing_of_its_source(site, built)
    links_and_images_lead_somewhere(built)
    the_reference_has_every_public_name(built, site)


def every_page_is_built_with_one_heading_and_nothing_of_its_source(site: Path, built: dict[Path, Page]) -> None:
    for page in PAGES:
        path = site / Path(page).with_suffix(".html")
        assert path in built, page
        assert len(built[path].headings) == 1, page
    for path, page in built.items():
        assert not (raw := RAW.search(page.prose)), f"{path}: {page.prose[max(raw.start() - 40, 0) : raw.end() + 40]!r}"


def links_and_images_lead_somewhere(built: dict[Path, Page]) -> None:
    n_images = 0
    for path, page in built.items():
        for name in [*page.links, *page.images]:
            link = urlsplit(name)
            if link.scheme or link.netloc or (not link.path and link.fragment in ("", "furo-main-content")):
                continue
            target = (path.parent / unquote(link.path)).resolve() if link.path else path
            assert target.is_file(), f"{path}: {name}"
            if link.fragment and target in built:
                assert link.fragment in built[target].ids, f"{path}: {name}"
        n_images += len(page.images)
    assert n_images > 20


def the_reference_has_every_public_name(built: dict[Path, Page], site: Path) -> None:
    ids = set().union(*(page.ids for path, page in built.items() if path.is_relative_to(site / "docs" / "api")))
    for name in sb3_abisim.__all__:
        thing = getattr(sb3_abisim, name)
        if callable(thing):
            assert f"{thing.__module__}.{thing.__name__}" in ids, name
    for method in methods().values():
        assert f"sb3_abisim.{method.extractor}" in ids
    rows = re.findall(r"<tr.*?</tr>", (site / "docs" / "api" / "index.html").read_text(encoding="utf-8"), re.DOTALL)
    sentences = [re.sub(r"<.*?>", "", row.rpartition("<td>")[2]).strip() for row in rows]
    assert len(sentences) > 30 and not [text for text in sentences if not re.search(r"\w.*\.$", text)]
    text = re.sub(r"\s+", " ", built[site / "docs" / "api" / "rl.html"].prose)
    assert "what observations are augmented by while they are learned from" in text, "a parameter's description"
