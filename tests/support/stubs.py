"""What packages offer, for type checkers: `python tests/support/stubs.py` writes a stub beside each that imports lazily."""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

from gapcert import lazy

ROOT = Path(__file__).parents[2]


def stubs() -> Iterator[tuple[Path, str]]:
    """Every stub, and what is to stand in it."""
    for top in ("core", "plugins"):
        for path in sorted((ROOT / top).rglob("*.py")):
            text = path.read_text()
            if "__class__ = LazyPackage" in text:
                yield path.with_suffix(".pyi"), stub(ast.parse(text))


def homes(tree: ast.Module) -> dict[str, str]:
    """Name → module, as a package that imports lazily has it."""
    made = next(n.value for n in tree.body if isinstance(n, ast.Assign) and ast.unparse(n.targets[0]) == "_HOME")
    table: dict[str, str] = lazy.homes(ast.literal_eval(made.args[0]))
    return table


def stub(tree: ast.Module) -> str:
    lines = sorted(homes(tree).items(), key=lambda item: (item[1], kind(item[0]), item[0]))
    line = "from gapcert import plugin as plugin\n"
    head = line if line in ast.unparse(tree) else ""
    return head + "".join(f"from {home} import {name} as {name}\n" for name, home in lines)


def kind(name: str) -> int:
    """Constants first, then classes, as the linter sorts them."""
    return 0 if name.isupper() and len(name) > 1 else 1 if name[0].isupper() else 2


def main() -> int:
    stale = [(path, text) for path, text in stubs() if not path.exists() or path.read_text() != text]
    for path, text in stale:
        path.write_text(text)
        print(path.relative_to(ROOT))
    return 0


if __name__ == "__main__":
    sys.exit(main())
