"""Names that became absolute or relative: what is new for users who choose a namespace."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

import sros_tool
from sros_tool.policy.document import read_policy
from sros_tool.policy.namespaces import changed_forms
from tests.support.code_host import NODE
from tests.support.code_host import policy as policy_text
from tests.support.harness import publish, sros


def policy_with(folder: Path, qualifier: str, names: str) -> Path:
    """Write a policy whose enclave /e may, or may not, publish ``names``."""
    file = folder / "robot.xml"
    rights = publish(*names.split()).replace("ALLOW", qualifier)
    file.write_text(policy_text({"/e": rights}).replace(NODE, ""))
    return file


def test_some_namespaces_are_not_every_namespace(tmp_path: Path) -> None:
    """A name that moves is not replaced by names in namespaces with certain letters."""

    def found(qualifier: str, *sides: str) -> list[str]:
        policies = [read_policy(policy_with(tmp_path, qualifier, names)) for names in sides]
        return [form.written for form in changed_forms(*(each.enclaves for each in policies))]

    for narrowed in ("/c /n*/c", "/c /[!l]*/c", "/c /[l]*/c /[!l]*/c", "/c /?/c", "/c */c"):
        assert found("DENY", "c", narrowed) == ["/c"], narrowed
    assert found("ALLOW", "/c /n*/c", "c") == ["c"]
    for before, after in (
        ("c /d", "/d c"),
        ("/c /n*/c", "/n*/c /c"),
        ("c", "c /n*/c"),
        ("c", "/*c"),
        ("c", "/c /*/c"),
        ("cmd*", "cmd cmd?*"),
        ("/cmd*", "/cmd /cmd?*"),
    ):
        assert found("DENY", before, after) == [], (before, after)


def test_an_enclave_under_a_new_name_is_compared_with_itself(tmp_path: Path) -> None:
    """Other lines of a comparison say of it only that it has the same rights."""
    base, *others = (
        [replace(enclave, path=path) for enclave in read_policy(file).enclaves]
        for path, names in (("/e", "cmd"), ("/new", "/cmd"), ("/new", "cmd"))
        for file in [policy_with(tmp_path, "ALLOW", names)]
    )
    found = [[str(form.right) for form in changed_forms(base, head)] for head in others]
    assert found == [["/new ALLOW publish topic /cmd"], []]


FIXED = "begins with / now, so that the namespace of its node does not apply"
MOVING = "no longer begins with /, so that the namespace of its node applies"


@pytest.mark.parametrize(
    ("qualifier", "before", "after", "says"),
    [
        ("ALLOW", "cmd", "/cmd", FIXED),
        ("ALLOW", "/cmd", "cmd", MOVING),
        ("ALLOW", "~/cmd", "/e/cmd", FIXED),
        ("DENY", "cmd", "/cmd", FIXED),
        ("ALLOW", "~/cmd", "e/cmd", ""),  # the same name in every namespace
    ],
)
def test_comparisons_show_what_changes_in_another_namespace(
    tmp_path: Path, qualifier: str, before: str, after: str, says: str
) -> None:
    for side, names in (("base", before), ("head", after)):
        (tmp_path / side).mkdir()
        policy_with(tmp_path / side, qualifier, names)
    sides = ("base/robot.xml", "head/robot.xml")
    compared = sros("diff_policy", *sides, cwd=tmp_path)
    markdown = sros("diff_policy", *sides, "--format", "markdown", cwd=tmp_path)
    as_json = json.loads(sros("diff_policy", *sides, "--json", cwd=tmp_path).out)
    assert compared.status == markdown.status == bool(says), compared
    assert (says in compared.out, says in markdown.out) == (True, True)
    assert ("rights are the same" in compared.err) == as_json["equal"] == (not says), compared
    assert len(as_json["changed_forms"]) == bool(says), as_json

    growth = sros_tool.new_access(*(tmp_path / side for side in sides))
    decided = sros("diff_policy", "--no-new-access", *sides, cwd=tmp_path)
    is_new = qualifier == "ALLOW" and bool(says)
    assert decided.status == bool(growth) == is_new, decided
    assert [form.written for form in growth.elsewhere] == [after] * is_new
    assert decided.err.startswith("nobody gets more access") == (not says), decided
    assert len(growth.dropped_denials) == (qualifier == "DENY")
    if is_new:
        assert " in another namespace  (head/robot.xml:" in decided.out, decided
        assert decided.err.startswith("1 right is new only for users who put the node"), decided
