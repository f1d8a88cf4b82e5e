"""How Sphinx makes the site of the pages: ``make docs``.

The pages are written for a reader of the repository, whose links lead from any folder into any other. So the repository
itself is Sphinx's source folder, and each link holds in both places as it is.
"""

import importlib
import inspect
import pkgutil
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import sb3_abisim  # noqa: E402
from sb3_abisim.registry import methods  # noqa: E402

project = "sb3_abisim"
version = release = sb3_abisim.__version__
# No year: the same pages give the same site.
project_copyright = "the authors of sb3_abisim, MIT license"
extensions = ["myst_parser", "sphinx.ext.autodoc"]
root_doc = "docs/index"
include_patterns = [
    "*.md", "docs/**.md", "docs/api/*.rst", "encoders/README.md", "benchmarks/encoders/README.md",
    "benchmarks/results/*.md", "sb3_abisim/media/*.md",
]  # fmt: skip
exclude_patterns = [".*", "site", "build", "logs", "demo", "data", "benchmark", "tests", "**/*.run"]

# Links to headings, as the repository's web view makes them.
myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence"]
# A rule of Python's lexer is no reason to refuse a page: blocks of commands are indented, and have no language.
highlight_language = "none"
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_default_options = {"members": True, "show-inheritance": True}
python_use_unqualified_type_names = True
# Each page holds the tree of all headings; with all names in it, most of the time would go there.
toc_object_entries = False

html_theme = "furo"
html_title = "sb3_abisim"
html_static_path = ["css"]
html_css_files = ["tables.css"]
html_copy_source = False
html_show_sphinx = False
html_theme_options = {"navigation_with_keys": True}

FOLDERS = (
    "common", "envs", "networks", "data", "objectives", "pretraining", "rl", "zoo", "analysis", "benchmark",
)  # fmt: skip
INTRODUCTION = """\
These names are importable from ``sb3_abisim``. So are ``TERMINATED``, ``TRUNCATED`` and ``CUT``, which say how a
segment of a dataset ends. The pages below the table describe every module, in the order of the data.

"""
OTHERS = ("registry", "demo", "doctor")
# A star before a name; or what is quoted, which stays as it is.
STAR = re.compile(r"``.*?``|`.*?`|\*(?=\w)")


def modules(folder: str) -> Iterator[str]:
    """Names of the modules below a folder of the package, without what is private.

    :param folder: such as ``envs``
    """
    package = importlib.import_module(f"sb3_abisim.{folder}")
    for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        if not found.ispkg and not found.name.rpartition(".")[2].startswith("_"):
            yield found.name


def _title(text: str) -> str:
    return f"{text}\n{'=' * len(text)}\n\n"


def _first_sentence(thing: object) -> str:
    # An alias of a generic class is described where the class is.
    paragraph = (inspect.getdoc(getattr(thing, "__origin__", thing)) or "").partition("\n\n")[0]
    return re.split(r"(?<=\.)\s", " ".join(paragraph.split()).replace("::", "."))[0]


def _public_names() -> str:
    """What is importable from ``sb3_abisim``, each with the place that describes it."""
    rows = []
    for name in sorted(sb3_abisim.__all__, key=str.casefold):
        thing = getattr(sb3_abisim, name)
        if callable(thing):
            # An alias is described where its class is.
            rows.append(
                f"   * - :py:obj:`{name} <{thing.__module__}.{thing.__name__}>`\n     - {_first_sentence(thing)}\n"
            )
    for method in methods().values():
        what = f"Features extractor of the method ``{method.name}`` ({method.label})."
        rows.append(f"   * - :py:class:`{method.extractor} <sb3_abisim.{method.extractor}>`\n     - {what}\n")
    return ".. list-table::\n   :widths: 30 70\n\n" + "".join(rows) + "\n"


def write_reference() -> None:
    """Write the pages of the reference, as ``sphinx-apidoc`` does, into ``docs/api/``; git does not keep them."""
    folder = ROOT / "docs" / "api"
    folder.mkdir(exist_ok=True)
    pages = {name: list(modules(name)) for name in FOLDERS}
    pages["others"] = [f"sb3_abisim.{name}" for name in OTHERS]
    contents = "\n".join(f"   {name}" for name in pages)
    index = _title("API reference") + INTRODUCTION + _public_names()
    index += f".. toctree::\n   :maxdepth: 2\n\n{contents}\n"
    texts = {"index": index}
    for name, names in pages.items():
        texts[name] = _title("registry, demo, doctor" if name == "others" else name)
        for module in names:
            texts[name] += f"{module}\n{'-' * len(module)}\n\n.. automodule:: {module}\n\n"
        if name == "rl":
            texts[name] += "Extractors of the methods\n-------------------------\n\n" + "".join(
                f".. autoclass:: sb3_abisim.{method.extractor}\n   :no-members:\n\n" for method in methods().values()
            )
    for name, text in texts.items():
        path = folder / f"{name}.rst"
        # What has not changed is not built again.
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def _keep_stars(app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Begin no emphasis at a star before a name, as shapes have it."""
    lines[:] = [STAR.sub(lambda match: "\\*" if match[0] == "*" else match[0], line) for line in lines]


def setup(app: Any) -> None:
    """Sphinx calls it once."""
    write_reference()
    app.connect("autodoc-process-docstring", _keep_stars)
    app.connect("build-finished", _lead_to_the_start)


def _lead_to_the_start(app: Any, exception: Exception | None) -> None:
    """The start page lies in ``docs/``, so the site's own index leads there."""
    if exception is None and app.builder.name == "html":
        page = '<!doctype html><meta charset="utf-8"><title>sb3_abisim</title>'
        page += '<meta http-equiv="refresh" content="0; url=docs/index.html"><a href="docs/index.html">sb3_abisim</a>\n'
        (Path(app.outdir) / "index.html").write_text(page, encoding="utf-8")
