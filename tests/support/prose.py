"""Check the language: docstrings, comments, messages, labels, templates, pages and notebooks.

    python tests/support/prose.py [--list] [FILE_OR_FOLDER ...]

Counts turns of phrase that an engineer would not write, by the rules below. Fails if a package, a
page or a notebook has more than ``BUDGET`` of them per 1000 words. A hit is a place to read again:
rewrite the sentence, with the standard term as its subject.
"""

from __future__ import annotations

import argparse
import ast
import io
import json
import re
import sys
import tokenize
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DEFAULT = ("svu_mi", "plugins", "scenes", "README.md", "CONTRIBUTING.md", "CHANGELOG.md",
           "SECURITY.md", "notebooks")  # fmt: skip
BUDGET = 2.0  # hits per 1000 words
WORDS = 3  # string literals with fewer words are names, keys and formats

# Each rule: what it finds, and what to write instead.
RULES = {
    r"\bwhat\b(?!\?| is new\b)": "name the noun: statistics, prior, options, photographs",
    r"\b(?:is|are|was|were) no(?:ne)?\b(?! longer)|\bnone of\b": "invalid, missing, not a ...",
    r"\b(?:nobody|whoever|somebody|anybody|those who|who sees|whose turn)\b":
        "the passive, or the name of the component",
    r"\b(?:says?|said|tells?|told|asks?|asked|believes?|believed|knows nothing)\b":
        "contain, indicate, return, request, assume, report",
    r"\b(?:of which|by which|those of|those that|that of|of those|of these|the same of|of it\b)":
        "a new sentence, or the noun again",
    r"\bso (?:many|much|few)\b|\bas (?:many|much) as\b|\bof (?:no )?matter\b": "the symbol: N, K",
    r"\b(?:go(?:es|ne)? on (?:from|with|after|where)|held? against|looks? (?:at|for)|"
    r"looked (?:at|for)|leaves? out|left out|leaving out|taken over|is there\b|are there\b|"
    r"of (?:its|their) own|by itself|all the same|besides)\b":
        "continue, compare with, sample, search, skip, omit, inherit, own, alone",
    r"\b(?:likes of|first best|beside|aside|by the shelf|in one piece|a piece of)\b":
        "similar texels, first, next to, background",
    r"\A(?:What|Whether|That|Those|Who|How)\b(?! [^.?]*\?)":
        "begin with an imperative verb, or with a noun",
}  # fmt: skip
COMPILED = {
    re.compile(rule, 0 if rule.startswith(r"\A") else re.I): fix for rule, fix in RULES.items()
}


def python_texts(source: str) -> Iterator[tuple[int, str]]:
    """Yield line and text of docstrings, comments and sentences in string literals."""
    tree = ast.parse(source)
    parts = {id(p) for n in ast.walk(tree) if isinstance(n, ast.JoinedStr) for p in n.values}
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            words = [p.value if isinstance(p, ast.Constant) else "X" for p in node.values]
            text = "".join(map(str, words))
        elif (
            isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in parts
        ):
            text = re.sub(r"``.*?``", "X", node.value.strip(), flags=re.DOTALL)
        else:
            continue
        if len(text.split()) >= WORDS:
            yield node.lineno, text
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT and not re.match(r"#( fmt| type| noqa|!)", token.string):
            yield token.start[0], token.string.lstrip("# ")


def markdown_texts(source: str) -> Iterator[tuple[int, str]]:
    """Yield line and text outside of code."""
    fenced = False
    for number, line in enumerate(source.splitlines(), 1):
        if line.lstrip().startswith("```"):
            fenced = not fenced
        elif not fenced and not line.startswith(("    ", "|--", "#!")):
            yield number, re.sub(r"`[^`]*`", "X", line)


def notebook_texts(source: str) -> Iterator[tuple[int, str]]:
    """Yield number of the cell and text: Markdown, and the code's comments and labels."""
    for number, cell in enumerate(json.loads(source)["cells"]):
        text = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            yield from ((number, line) for _, line in markdown_texts(text))
        elif cell["cell_type"] == "code":
            code = re.sub(r"^[%!].*$", "", text, flags=re.MULTILINE)
            yield from ((number, line) for _, line in python_texts(code))


def template_texts(source: str) -> Iterator[tuple[int, str]]:
    """Yield line and text of an HTML template."""
    hidden = r"<(style|script)\b.*?</\1>|<[^>]*>|{#.*?#}|{%.*?%}|{{.*?}}"
    blank = re.sub(hidden, lambda m: " X " + "\n" * m[0].count("\n"), source, flags=re.DOTALL)
    yield from enumerate(blank.splitlines(), 1)


READERS = {".py": python_texts, ".md": markdown_texts, ".rst": markdown_texts,
           ".ipynb": notebook_texts, ".html": template_texts}  # fmt: skip


def hits(path: Path) -> tuple[int, list[str]]:
    """Return the number of words of a file, and a line for each hit."""
    words, lines = 0, []
    for line, text in READERS[path.suffix](path.read_text(encoding="utf-8")):
        words += len(text.split())
        for pattern, fix in COMPILED.items():
            for match in pattern.finditer(text):
                around = text[max(match.start() - 40, 0) : match.end() + 40].replace("\n", " ")
                at = line + text.count("\n", 0, match.start())
                lines.append(f"{path}:{at}: {match[0]!r} in '{around}'; instead: {fix}")
    return words, lines


def room(path: Path) -> str:
    """Return the package of a module, or the page itself: the unit that has a budget."""
    inside = path.parts
    if inside[0] == "svu_mi":
        return "/".join(inside[:2]) if len(inside) > 2 else "svu_mi/*.py"
    return inside[0] if inside[0] in ("plugins", "scenes") else str(path)


def main() -> int:
    """Print hits per package and page; return 1 if one is above the budget."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "paths",
        nargs="*",
        type=Path,
        default=[p for p in (ROOT / n for n in DEFAULT) if p.exists()],
    )
    parser.add_argument("--list", action="store_true", help="print every hit")
    options = parser.parse_args()
    words: dict[str, int] = defaultdict(int)
    lines: dict[str, list[str]] = defaultdict(list)
    for path in options.paths:
        files = sorted(path.rglob("*")) if path.is_dir() else [path]
        readable = [f for f in files if f.suffix in READERS and "checkpoints" not in str(f)]
        for file in (f.resolve().relative_to(ROOT) for f in readable):
            count, found = hits(ROOT / file)
            words[room(file)] += count
            lines[room(file)] += [line.replace(f"{ROOT}/", "") for line in found]
    rates = {name: 1000 * len(lines[name]) / max(words[name], 1) for name in words}
    over = [name for name, rate in rates.items() if rate > BUDGET]
    for name in sorted(rates, key=rates.__getitem__, reverse=True):
        if options.list or name in over:
            print(*lines[name], sep="\n", end="\n" if lines[name] else "")
    for name in over:
        print(f"{name}: {len(lines[name])} hits in {words[name]} words, {rates[name]:.1f} per 1000")
    count, total = sum(map(len, lines.values())), sum(words.values())
    print(f"{count} hits in {total} words: {1000 * count / max(total, 1):.2f} per 1000")
    return int(bool(over))


if __name__ == "__main__":
    sys.exit(main())
