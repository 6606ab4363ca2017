"""Plain English in docstrings, comments and names: each file has an allowance that only shrinks.

`python tests/test_prose.py hamkernel/_gram.py …` lists what is found in some files, and
`python tests/test_prose.py --shrink` lowers the allowances to what is left.
"""

import ast
import re
import sys
import tokenize
from pathlib import Path

ROOT = Path(__file__).parent.parent
ALLOWANCES = Path(__file__).with_name("prose_allowances.txt")
MOST_WORDS = 40  # of a sentence

# A docstring, a comment and the text of an argument open with the noun that they are about.
VAGUE_OPENING = re.compile(r"(what|those|that|it|its|they|theirs|these|such)\b", re.IGNORECASE)
VAGUE_ENTRY = re.compile(r"\w+: (of|that|those|what|it|theirs)\b")
POINTER = re.compile(r"\b(that|those) of\b")

PREPOSITIONS = set("of at in on without by for beside below above into less than".split())
PRONOUNS = set("own other others each both some most whole theirs mine it that those same".split())
# Participles that do not end in -ed. `known`, `split` and the like are fine as adjectives.
PARTICIPLES = set(
    "given left found seen begun made drawn lost kept chosen taken shown rubbed".split()
)
# Names of variables that say nothing of what they hold.
EMPTY_NAMES = set("given left found own other others known each most whole seen".split())
NOT_PARTICIPLES = set("seed speed feed need embed bed shed red".split())


def sentences(text):
    """The sentences of a docstring or a comment; formulas and code, which are indented, are not."""
    for paragraph in re.split(r"\n\s*\n", text):
        lines = [line for line in paragraph.splitlines() if line.strip()]
        if lines and len(lines[0]) - len(lines[0].lstrip()) >= 4:
            continue
        prose = " ".join(re.sub(r"^(\s+)(\w+: )", r". \2", line).strip() for line in lines)
        yield from re.split(r"(?<=[.!?])\s+", prose)


def comments(path):
    """(line, text) of every comment; comments on neighbouring lines are one text."""
    block, last = [], (0, 0)
    with tokenize.open(path) as file:
        for token in tokenize.generate_tokens(file.readline):
            if token.type != tokenize.COMMENT or re.match(r"# (type|pyright|noqa)", token.string):
                continue
            if token.start != (last[0] + 1, last[1]):
                block.append((token.start[0], []))
            block[-1][1].append(token.string.lstrip("# "))
            last = token.start
    return [(line, "\n".join(lines)) for line, lines in block]


def faults_of_text(text):
    """The faults of one docstring or comment."""
    if VAGUE_OPENING.match(text):
        yield f"opens with {text.split()[0]!r}"
    for entry in re.findall(r"^\s{4}(\w+: \w+)", text, re.MULTILINE):
        if VAGUE_ENTRY.match(entry):
            yield f"an entry without a noun: {entry!r}"
    for sentence in sentences(text):
        words = re.findall(r"[^\W\d_]{2,}", sentence)
        if len(words) > MOST_WORDS:
            yield f"{len(words)} words: {sentence[:60]}…"
        if len(POINTER.findall(sentence)) > 1:
            yield f"'that of' more than once: {sentence[:60]}…"


def is_no_noun_or_verb(name):
    """Whether the name of a function is a participle, a pronoun or a preposition."""
    if name[0].isupper():  # a structure, such as Odd, Even and Structured
        return False
    tokens = name.strip("_").split("_")
    if tokens[0] in PREPOSITIONS | PRONOUNS:
        return True
    participle = tokens[0].endswith("ed") or tokens[0] in PARTICIPLES
    return len(tokens) == 1 and participle and tokens[0] not in NOT_PARTICIPLES


def names_of(function):
    """The names that a function binds; `left` beside `right` is a side."""
    names = [node.arg for node in ast.walk(function.args) if isinstance(node, ast.arg)]
    for node in ast.walk(function):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.append(node.id)
    return [name for name in names if name != "left" or "right" not in names]


def faults(path):
    """(line, fault) of a file, in order."""
    found = [(line, fault) for line, text in comments(path) for fault in faults_of_text(text)]
    for node in ast.walk(ast.parse(path.read_text())):
        line = getattr(node, "lineno", 1)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            found += [(line, fault) for fault in faults_of_text(ast.get_docstring(node) or "")]
        if isinstance(node, ast.FunctionDef):
            if is_no_noun_or_verb(node.name):
                found.append((line, f"the function {node.name}"))
            allowed = {"other"} if node.name.startswith("__") else set()  # `__eq__(self, other)`
            empty = [name for name in names_of(node) if name in EMPTY_NAMES - allowed]
            found += [(line, f"the variable {name} of {node.name}") for name in empty]
    return sorted(found)


def counts():
    """The number of faults of every file of the package that has any."""
    found = {str(p.relative_to(ROOT)): len(faults(p)) for p in (ROOT / "hamkernel").rglob("*.py")}
    return {name: count for name, count in sorted(found.items()) if count}


def allowances():
    """The allowance of every file, a line for each, so that two changes merge easily."""
    rows = (line.split() for line in ALLOWANCES.read_text().splitlines())
    return {name: int(count) for name, count in rows}


def test_no_file_is_harder_to_read_than_it_was():
    now, allowed = counts(), allowances()
    worse = {name: count for name, count in now.items() if count > allowed.get(name, 0)}
    assert not worse, f"list them with `python tests/test_prose.py {' '.join(worse)}`"
    spare = {name for name, count in allowed.items() if count > now.get(name, 0)}
    assert not spare, f"run `python tests/test_prose.py --shrink`: {spare} have improved"


def test_the_check_notices_each_pattern(tmp_path):
    file = tmp_path / "bad.py"
    long = " ".join(["word"] * 41)
    file.write_text(
        f'"""What it says.\n\n{long}.\n"""\n\n\ndef begun(given):\n    # That of b.\n    return 1\n'
    )
    assert len(faults(file)) == 5
    assert list(faults_of_text("The norm of a is that of b, and those of c."))
    file.write_text('"""The sum of a and b."""\n\n\ndef add(a, b):\n    return a + b\n')
    assert not faults(file)


if __name__ == "__main__":
    if sys.argv[1:] == ["--shrink"]:
        old = allowances() if ALLOWANCES.exists() else counts()
        kept = {name: min(count, old.get(name, 0)) for name, count in counts().items()}
        ALLOWANCES.write_text("".join(f"{name} {count}\n" for name, count in kept.items() if count))
    for name in sys.argv[1:] if sys.argv[1:] != ["--shrink"] else []:
        for line, fault in faults(Path(name).resolve()):
            print(f"{name}:{line}: {fault}")
