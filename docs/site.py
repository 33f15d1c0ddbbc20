"""Hooks of the site: README is its first page, and what lies outside docs/ is named, not linked."""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parents[1]
LINK = re.compile(r'(!?)\[([^]]*)\]\((?!https?:|#)([^)#]+)(#[^)]*)?\)')


def on_files(files: Any, config: Any) -> Any:
    """Add README as the first page."""
    readme = (ROOT / 'README.md').read_text(encoding='utf-8')
    files.append(File.generated(config, 'index.md', content=readme))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Bring the links of a page into the site."""
    name = page.file.src_uri
    folder = '.' if name == 'index.md' else posixpath.join('docs', posixpath.dirname(name))
    return LINK.sub(lambda link: _in_site(link, folder, posixpath.dirname(name)), markdown)


def _in_site(link: re.Match[str], folder: str, here: str) -> str:
    picture, text, target, anchor = link.groups(default='')
    path = posixpath.normpath(posixpath.join(folder, target))
    if path == 'README.md':
        path = 'docs/index.md'
    if path.startswith('docs/') and (path == 'docs/index.md' or (ROOT / path).is_file()):
        relative = posixpath.relpath(path.removeprefix('docs/'), here or '.')
        return f'{picture}[{text}]({relative}{anchor})'
    return f'{text} (`{path}`)'
