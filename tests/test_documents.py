"""The README and the documents: short enough, and every link leads somewhere."""

import json
import re
import subprocess
from pathlib import Path

import jsonschema
import pytest

import jaxpanda

ROOT = Path(__file__).parents[1]
DOCUMENTS = sorted(
    path
    for pattern in ("*.md", "docs/*.md", "kernels/*.md", "experiments/*/*.md")
    for path in ROOT.glob(pattern)
)


def anchors(path: Path) -> set[str]:
    """Of the headings, as GitHub makes them."""
    text = re.sub(r"^```.*?^```", "", path.read_text(), flags=re.DOTALL | re.MULTILINE)
    heads = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


def test_the_readme_is_read_in_a_few_minutes():
    assert len((ROOT / "README.md").read_text().split()) <= 600
    assert (ROOT / "docs" / "diagnosis.png").stat().st_size < 60_000


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_link_within_the_project_leads_somewhere(path):
    text = re.sub(r"^```.*?^```|`[^`\n]*`", "", path.read_text(), flags=re.DOTALL | re.MULTILINE)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, anchor = target.partition("#")
        file = path.parent / name if name else path
        assert file.exists(), target
        assert not anchor or anchor in anchors(file), target


@pytest.mark.parametrize(
    ("mark", "starts"), [("test-setup", "python3 -m venv"), ("test-run", ".venv/bin/pytest")]
)
def test_the_checks_find_their_commands_in_the_readme(mark, starts):
    (line,) = re.findall(r"^command_after\(\).*$", (ROOT / ".ci" / "run").read_text(), re.MULTILINE)
    found = subprocess.run(
        ["bash", "-c", f"{line}\ncommand_after {mark}"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert found.stdout.startswith(starts)
    assert found.stdout.count("\n") == 1


def test_every_public_name_is_in_the_reference():
    text = (ROOT / "docs" / "api.md").read_text()
    assert [
        name for name in dir(jaxpanda) if not re.search(rf":: jaxpanda\.{name}$", text, re.MULTILINE)
    ] == []


@pytest.mark.parametrize("path", sorted(ROOT.glob("docs/schemas/*.json")), ids=lambda path: path.name)
def test_every_schema_is_one_and_is_told_of(path):
    jsonschema.Draft202012Validator.check_schema(json.loads(path.read_text()))
    assert f"schemas/{path.name}" in (ROOT / "docs" / "schemas.md").read_text()
