"""Make a site of the project's pages: hooks of mkdocs, named in mkdocs.yml.

The pages link to each other as they lie in the repository. The site has README.md as its first
page, the other pages beside docs/, and the source files that pages link to.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files, InclusionLevel

ROOT = Path(__file__).resolve().parents[1]
BESIDE = {"README.md": "index.md"} | {
    name: name for name in ("CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md")
}
"""Pages beside docs/, and their names in the site."""


def on_files(files: Files, config: Any) -> Files:
    """Add the pages beside docs/ and the linked source files."""
    sources = {
        link
        for page in (ROOT / "docs").glob("*.md")
        for link in re.findall(r"\]\(\.\./(us_sim/[^)#]+)", page.read_text(encoding="utf-8"))
    }
    for name, place in [*BESIDE.items(), *((link, link) for link in sorted(sources))]:
        file = str(ROOT / name)
        level = InclusionLevel.INCLUDED if place.endswith(".md") else InclusionLevel.NOT_IN_NAV
        files.append(File.generated(config, place, abs_src_path=file, inclusion=level))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Turn the repository's links into the site's."""
    if "/" in page.file.src_uri:
        return markdown  # of a report, whose links are within docs/
    return re.sub(
        r"\]\((?:docs/|\.\./)(README\.md)?",
        lambda found: f"]({BESIDE.get(found[1] or '', '')}",
        markdown,
    )
