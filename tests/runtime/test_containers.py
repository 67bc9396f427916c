"""Services of Compose and objects of Kubernetes: their schemas, names, and hostile values."""

from __future__ import annotations

import base64
import json
from dataclasses import replace
from functools import cache
from importlib.util import find_spec
from itertools import combinations
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from jsonschema import Draft202012Validator, ValidationError

from sros_tool.errors import KeystoreError, UsageError
from sros_tool.runtime.environment import (
    COMPOSE,
    CONTAINER_FORMS,
    KUBERNETES,
    MAX_SECRET,
    Container,
    check_name,
    object_name,
    render_container,
    render_refusal,
    render_secret,
    secret_name,
    secured_environment,
)
from sros_tool.values import yaml_text
from tests.runtime.test_environment import CONTROLS, PATHS

VERSIONS = ("1.28", "1.31")
VARIABLES = secured_environment(Path("/etc/sros/keystore"), "/arm", 7)
FOLDER = "/etc/sros/keystore/enclaves/arm"
ARM = Container("/arm", "arm", VARIABLES, FOLDER, "robot/arm:1")


@cache
def compose_schema() -> Draft202012Validator:
    """The schema of the Compose Specification, which check-jsonschema ships."""
    place = find_spec("check_jsonschema")  # importing it needs a newer click than sros does
    assert place and place.origin
    path = Path(place.origin).parent / "builtin_schemas/vendor/compose-spec.json"
    return Draft202012Validator(json.loads(path.read_text("utf-8")))


def check(document: str, form: str) -> Any:
    """Return the value of a document that fits the schema of its form; fail if it does not."""
    value = yaml.safe_load(document)
    if form == COMPOSE:
        compose_schema().validate(value)
    else:
        for version in VERSIONS:
            kubernetes_validate.validate(value, version, strict=True)
    return value


@pytest.mark.parametrize("image", ["", "robot/arm:1"])
def test_a_service_fits_the_schema_of_compose(image: str) -> None:
    shown = render_container(replace(ARM, image=image), COMPOSE)
    made = check(shown, COMPOSE)
    service = made["services"]["arm"]
    assert service.get("image", "") == image
    assert VARIABLES.items() <= service["environment"].items()
    (mount,) = service["volumes"]
    assert (mount["source"], mount["target"], mount["read_only"]) == (FOLDER, FOLDER, True)
    assert service["read_only"] is True and service["cap_drop"] == ["ALL"]
    with pytest.raises(ValidationError):  # the schema finds what is misspelt
        check(shown.replace("cap_drop", "drop_cap"), COMPOSE)


@pytest.mark.parametrize("image", ["", "robot/arm:1"])
def test_a_deployment_fits_the_schema_of_kubernetes(image: str) -> None:
    shown = render_container(replace(ARM, image=image), KUBERNETES)
    made = check(shown, KUBERNETES)
    pod = made["spec"]["template"]["spec"]
    (process,) = pod["containers"]
    assert process.get("image", "") == image
    found = {each["name"]: each["value"] for each in process["env"]}
    assert VARIABLES.items() <= found.items()
    mounts = {each["name"]: each for each in process["volumeMounts"]}
    volumes = {each["name"]: each for each in pod["volumes"]}
    assert mounts.keys() == volumes.keys()
    assert mounts["sros-enclave"] == {
        "name": "sros-enclave", "mountPath": FOLDER, "readOnly": True,
    }  # fmt: skip
    secret = volumes["sros-enclave"]["secret"]
    assert secret == {"secretName": secret_name("/arm"), "defaultMode": 0o400}
    assert pod["securityContext"]["runAsNonRoot"] and pod["securityContext"]["fsGroup"]
    assert process["securityContext"]["capabilities"] == {"drop": ["ALL"]}
    assert found["ROS_LOG_DIR"] == mounts["tmp"]["mountPath"]
    with pytest.raises(kubernetes_validate.ValidationError):
        check(shown.replace("readOnlyRootFilesystem", "readOnlyRoot"), KUBERNETES)


def test_a_secret_has_the_files_up_to_what_kubernetes_takes() -> None:
    parts = {"key.pem": b"\x00secret", "cert.pem": b"x" * (MAX_SECRET - 7)}
    made = check(render_secret("/arm", parts), "kubernetes-secret")
    assert made["metadata"]["name"] == secret_name("/arm")
    assert {name: base64.b64decode(each) for name, each in made["data"].items()} == parts
    with pytest.raises(KeystoreError, match="1048577 bytes"):
        render_secret("/arm", {**parts, "crl.pem": b"x"})


@pytest.mark.parametrize("form", CONTAINER_FORMS)
def test_a_refusal_fits_no_schema(form: str) -> None:
    refusal = render_refusal(form)
    with pytest.raises(Exception, match=r"refused-by-sros|apiVersion|kind"):
        check(refusal, form)


# ── hostile values ─────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("form", [COMPOSE, KUBERNETES])
@pytest.mark.parametrize("name", PATHS)
def test_a_path_stays_one_value_that_nothing_is_replaced_in(name: str, form: str) -> None:
    path = PATHS[name]
    container = Container("/arm", "arm", {"A": path, "B": "$(A) ${A}"}, path, path)
    if name in CONTROLS:
        with pytest.raises(UsageError):
            render_container(container, form)
        return
    made = check(render_container(container, form), form)
    doubled = {"A": path.replace("$", "$$"), "B": "$$(A) $${A}", "ROS_LOG_DIR": "/tmp"}
    if form == COMPOSE:
        assert made["services"]["arm"]["environment"] == doubled
        assert made["services"]["arm"]["volumes"][0]["source"] == doubled["A"]
        assert list(made["services"]) == ["arm"]
    else:
        (process,) = made["spec"]["template"]["spec"]["containers"]
        assert {each["name"]: each["value"] for each in process["env"]} == doubled
        assert process["volumeMounts"][0]["mountPath"] == path


TEXTS = st.text(st.characters(codec="utf-8"))


@given(
    st.recursive(
        st.one_of(st.booleans(), st.integers(), TEXTS),
        lambda inner: st.one_of(st.lists(inner), st.dictionaries(TEXTS, inner)),
        max_leaves=10,
    )
)
def test_yaml_says_what_was_given(value: object) -> None:
    assert yaml.safe_load(yaml_text(value)) == value


# What is not quoted in one version of YAML, and something else in the other, has quotes.
NOT_PLAIN = (
    *("", "yes", "On", "NULL", "~", "1e3", "0o7", "0x1", "012", "1_0", "12:30", "2027-01-01"),
    *(".nan", "- a", "a: b", "#a", "&a", "*a", "!a", "<<", "=", "|", "{}", "a\nb: c", "\ufeff"),
    *("\x85", "\u2028", "\U000e0001", "\x7f"),
)


@pytest.mark.parametrize("text", NOT_PLAIN)
def test_a_text_of_yaml_is_never_anything_else(text: str) -> None:
    for value in (text, {text: text}, [text], {"a": [{"b": text}]}):
        assert yaml.safe_load(yaml_text(value)) == value
    shown = yaml_text(text)
    assert shown[0] == shown[-2] == '"' and shown[:-1].isprintable()


def test_other_values_have_no_yaml() -> None:
    assert yaml_text({"a": "/b/c.d-e_f"}) == "a: /b/c.d-e_f\n"
    with pytest.raises(TypeError):
        yaml_text({"a": b"bytes"})


# ── names ──────────────────────────────────────────────────────────────────────────────────

ENCLAVES = (
    *("/", "/a", "/A", "/a/b", "/a_b", "/a__b", "/a_/b", "/a/_b", "/ab", "/aB", "/Ab", "/root"),
    *("/_", "/__", "/a" * 32, "/b" + "/a" * 31, "/" + "x" * 63, "/" + "x" * 62 + "_", "/a/root"),
)


def test_names_of_objects_are_of_one_enclave_and_valid() -> None:
    names = {enclave: object_name(enclave) for enclave in ENCLAVES}
    assert all(one != other for one, other in combinations(names.values(), 2))
    for enclave, name in names.items():
        check_name(name, KUBERNETES)
        check_name(secret_name(enclave), KUBERNETES)
        check_name(name, COMPOSE)
    assert names["/a/b"] == "a-b"
    assert names["/"].startswith("root--")


@given(st.lists(st.from_regex(r"(/[aAbB_][aAbB_0]{0,3}){1,3}\Z"), min_size=2, unique=True))
def test_no_two_enclaves_have_one_name(enclaves: list[str]) -> None:
    enclaves = [each.rstrip("\n") for each in enclaves]
    assert len({object_name(each) for each in enclaves}) == len(set(enclaves))


@pytest.mark.parametrize("form", [COMPOSE, KUBERNETES])
@pytest.mark.parametrize(
    "name", ["", "-a", "a b", "a\nb", "a:b", "a/b", "ä", "a{", "a\n", "x" * 500 + "/"]
)
def test_a_name_that_is_none_is_refused(name: str, form: str) -> None:
    with pytest.raises(UsageError):
        check_name(name, form)
