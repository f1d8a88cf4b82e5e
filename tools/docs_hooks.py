"""What mkdocs does beside its own work (``make docs``): the repository's other pages join, and the API's reference.

The pages are written for a reader of the repository, so links lead out of ``docs/`` (``../benchmarks/results/...``).
Every file that such a link names is taken into the site, under ``repository/``, and the link is turned there. README.md
is the start page.
"""

import importlib
import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parent.parent
START = "index.md"
LINK = re.compile(r"(?<=\]\()(?!\w+:|#)([^)#\s]+)")
# The reference, in the order of the data.
MODULES = (
    "registry", "common.cli", "envs.base", "envs.sb3_vec_env", "envs.nav2d", "envs.point_maze.env",
    "envs.point_maze.distractors", "envs.point_maze.pixel_wrapper", "envs.scan_nav.env", "envs.scan_nav.build",
    "envs.scan_nav.map", "networks.base", "networks.top", "networks.paper", "networks.encoder_file", "data.collect",
    "data.rollout", "data.dataset", "data.writer", "data.importing", "data.readers.arrays", "data.readers.buffer",
    "data.readers.lerobot", "data.readers.minari", "objectives.base", "objectives.abisim", "objectives.goal_progress",
    "objectives.ssi", "objectives.acro", "objectives.info_nce", "objectives.beta_vae", "objectives.curl",
    "pretraining.pretrain", "pretraining.config", "pretraining.card", "rl.extractors", "rl.extractor_classes",
    "rl.task_features", "rl.augment", "rl.checks", "rl.vec_encode", "rl.merge", "rl.callbacks", "rl.fine_tuning",
    "rl.critic_routing", "rl.optimizers", "rl.auxiliary",
    "zoo.entries", "zoo.methods", "zoo.method_record", "zoo.manager", "zoo.runs", "zoo.evaluate", "zoo.record",
    "analysis.exact_metric", "analysis.nav2d_exact", "analysis.leak",
)  # fmt: skip


def repository_path(page: str) -> str:
    """Where a page of the site lies in the repository."""
    if page == START:
        return "README.md"
    return page.removeprefix("repository/") if page.startswith("repository/") else f"docs/{page}"


def site_path(path: str) -> str:
    """Where a file of the repository lies in the site."""
    if path == "README.md":
        return START
    return path.removeprefix("docs/") if path.startswith("docs/") else f"repository/{path}"


def target(link: str, on: str) -> str:
    """The repository's path of what a link on a page names."""
    return posixpath.normpath(posixpath.join(posixpath.dirname(repository_path(on)), link))


def on_files(files: Files, config: Any) -> Files:
    """Add the pages and files that are outside of ``docs/``."""
    reference = "\n\n".join(f"::: sb3_abisim.{name}" for name in MODULES)
    files.append(File.generated(config, "api.md", content=f"# API\n\n{reference}\n"))
    waiting = ["README.md", *(f"docs/{path.relative_to(ROOT / 'docs')}" for path in (ROOT / "docs").rglob("*.md"))]
    seen = set(waiting)
    while waiting:
        path = waiting.pop()
        if not path.startswith("docs/"):
            files.append(File.generated(config, site_path(path), abs_src_path=str(ROOT / path)))
        if path.endswith(".md"):
            found = {target(link, site_path(path)) for link in LINK.findall((ROOT / path).read_text())}
            new = {
                other
                for other in found
                if (ROOT / other).is_file() and not (ROOT / other).is_relative_to(ROOT / "docs")
            }
            waiting += sorted(new - seen)
            seen |= new
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Turn links to where the files lie in the site."""
    here = page.file.src_uri

    def turned(match: re.Match[str]) -> str:
        other = target(match[0], here)
        if (ROOT / other).is_dir():
            other = posixpath.join(other, "README.md")
        if not (ROOT / other).is_file():
            return match[0]
        return posixpath.relpath(site_path(other), posixpath.dirname(here) or ".")

    return markdown if here == "api.md" else LINK.sub(turned, markdown)


def on_page_content(html: str, page: Any, config: Any, files: Files) -> str:
    """Images lead to themselves at full size; Sphinx's roles, as in SB3's docstrings, are not known to mkdocs."""
    html = re.sub(r'(<img[^>]* src="([^"]+)"[^>]*>)', r'<a href="\2">\1</a>', html)
    return re.sub(r":(?:class|data|func|meth|mod):(?:<code>~?)", "<code>", html)


def on_config(config: Any) -> Any:
    """A reference with a hole is a mistake of the list above."""
    for name in MODULES:
        importlib.import_module(f"sb3_abisim.{name}")
    return config
