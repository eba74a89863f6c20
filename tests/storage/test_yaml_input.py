"""Invalid YAML is refused in one sentence with file, line, key path, rule and value."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel, ConfigDict, Field, model_validator
from ruamel.yaml import YAML

from mitsplat.errors import InputError
from mitsplat.storage.files import yaml_scalar
from mitsplat.storage.yaml_input import FieldError, key_place, load_yaml


class Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class Circle(Strict):
    kind: Literal["circle"] = "circle"
    radius: float = Field(gt=0)


class Polygon(Strict):
    kind: Literal["polygon"] = "polygon"
    corners: tuple[tuple[float, float], ...] = Field(min_length=3)


class Inner(Strict):
    low: int = 0
    high: int = 10

    @model_validator(mode="after")
    def _check(self) -> Inner:
        if self.low > self.high:
            raise FieldError("high", f"must be >= low (got {self.high})")
        return self


class Drawing(Strict):
    title: str
    copies: int = Field(1, ge=1)
    shapes: tuple[Annotated[Circle | Polygon, Field(discriminator="kind")], ...] = ()
    inner: Inner | None = None
    draft: bool = False


@pytest.fixture
def drawing(tmp_path: Path) -> Path:
    return tmp_path / "drawing.yaml"


def refusal(path: Path, text: str, **overrides: object) -> str:
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        load_yaml(path, Drawing, overrides={key.replace("__", "."): value for key, value in overrides.items()})
    message = str(caught.value)
    assert message.startswith(str(path))
    assert "\n" not in message
    return message.removeprefix(str(path))


def test_a_valid_file_fills_the_model(drawing: Path) -> None:
    drawing.write_text(
        "title: a\nshapes:\n- {kind: circle, radius: 2}\n- {kind: polygon, corners: [[0, 0], [1, 0], [0, 1]]}\n"
    )
    model = load_yaml(drawing, Drawing, overrides={"copies": 3, "inner.low": 2})
    assert model.copies == 3
    assert model.inner == Inner(low=2)
    assert model.shapes[0] == Circle(radius=2)
    assert type(model.title) is str


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("title: a\ncopies: -3\n", ":2: copies: must be >= 1 (got -3)"),
        ("title: a\ncopies: '3'\n", ':2: copies: must be a whole number (got "3")'),
        ("title: a\ncopies: true\n", ":2: copies: must be a whole number (got true)"),
        ("title: a\ncopies: 1.5\n", ":2: copies: must be a whole number (got 1.5)"),
        ("title: a\ncopys: 3\n", ":2: copys: is not a known key (did you mean 'copies'?)"),
        ("tittle: a\n", ":1: tittle: is not a known key (did you mean 'title'?)"),
        ("title: a\nzzz: 1\n", ":2: zzz: is not a known key (known keys: title, copies, shapes, inner, draft)"),
        ("copies: 1\n", ":1: title: is required"),
        ("title: 3\n", ":1: title: must be text (got 3)"),
        ("title: a\ndraft: yes\n", ':2: draft: must be true or false (got "yes")'),
        ("title: a\nshapes: 3\n", ":2: shapes: must be a list (got 3)"),
        ("title: a\nshapes:\n- 3\n", ":3: shapes[0]: must be a mapping of keys to values (got 3)"),
        (
            "title: a\nshapes:\n- kind: circle\n  radius: -1\n",
            ":4: shapes[0].radius: must be > 0 (got -1)",
        ),
        (
            "title: a\nshapes:\n- kind: circle\n  radius: .inf\n",
            ":4: shapes[0].radius: must be finite (got Infinity)",
        ),
        (
            "title: a\nshapes:\n- kind: circle\n  raduis: 1\n",
            ":4: shapes[0].raduis: is not a known key (did you mean 'radius'?)",
        ),
        ("title: a\nshapes:\n- kind: circle\n", ":3: shapes[0].radius: is required"),
        ("title: a\nshapes:\n- radius: 1\n", ":3: shapes[0].kind: is required, one of circle, polygon"),
        (
            "title: a\nshapes:\n- kind: oval\n",
            ":3: shapes[0].kind: must be one of 'circle', 'polygon' (got \"oval\")",
        ),
        (
            "title: a\nshapes:\n- kind: polygon\n  corners:\n  - [0, 0]\n  - [1]\n  - [0, 1]\n",
            ":6: shapes[0].corners[1]: must have 2 items (got 1)",
        ),
        (
            "title: a\nshapes:\n- kind: polygon\n  corners: [[0, 0]]\n",
            ":4: shapes[0].corners: must have 3 or more items (got [[0, 0]])",
        ),
        ("title: a\ninner:\n  low: 3\n  high: 2\n", ":4: inner.high: must be >= low (got 2)"),
        ("title: a\ntitle: b\n", ':2: keys must be unique (found duplicate key "title")'),
        ("title: [a\n", ":2: not YAML: expected ',' or ']', but got '<stream end>'"),
        (
            "title: a\n\tcopies: 1\n",
            ":2: not YAML: found character '\\t' that cannot start any token; use spaces in place of tabs",
        ),
        ("title: *a\n", ":1: not YAML: found undefined alias 'a'"),
        ("title: 2020-13-45\n", ": not YAML: month must be in 1..12"),
        ("", ": must be a mapping of keys to values (got nothing)"),
        ("- a\n", ': must be a mapping of keys to values (got ["a"])'),
        ("1: a\n", ":1: keys must be text (got 1)"),
        ("a: 1\n5: b\n", ":2: keys must be text (got 5)"),
    ],
)
def test_an_invalid_file_is_refused_with_line_and_key(drawing: Path, text: str, sentence: str) -> None:
    assert refusal(drawing, text) == sentence


def test_yaml_tags_run_no_code(drawing: Path, tmp_path: Path) -> None:
    witness = tmp_path / "witness"
    text = f"title: !!python/object/apply:os.mkdir ['{witness}']\n"
    assert "title: must not have a YAML tag" in refusal(drawing, text)
    assert not witness.exists()


@pytest.mark.parametrize("text", ["&x\ntitle: *x\n", "title: " + "[" * 2000 + "]" * 2000])
def test_deep_or_recursive_nesting_is_refused(drawing: Path, text: str) -> None:
    assert refusal(drawing, text) == ": must not nest deeper than 32 levels"


def test_an_invalid_override_is_refused_without_a_line(drawing: Path) -> None:
    text = "title: a\ncopies: 2\n"
    assert refusal(drawing, text, copies=0) == ": copies: must be >= 1 (got 0)"
    assert refusal(drawing, text, inner__hihg=0) == ": inner.hihg: is not a known key (did you mean 'high'?)"


def test_unreadable_files_are_refused(tmp_path: Path) -> None:
    binary = tmp_path / "binary.yaml"
    binary.write_bytes(b"title: \xff\n")
    for path, sentence in [
        (tmp_path / "absent.yaml", "no such file"),
        (tmp_path, "must be a file"),
        (binary, "must be YAML in UTF-8 (invalid start byte at byte 7)"),
    ]:
        with pytest.raises(InputError) as caught:
            load_yaml(path, Drawing)
        assert str(caught.value) == f"{path}: {sentence}"


def test_the_place_of_a_key_has_its_line(drawing: Path) -> None:
    drawing.write_text("title: a\nshapes:\n- kind: circle\n  radius: 1\n")
    assert key_place(drawing, ("shapes", 0, "radius")) == f"{drawing}:4: shapes[0].radius"


@given(text=st.text(alphabet="abc:-[]{}&*!|>'\"#, \n\t0.", max_size=60))
def test_random_text_is_read_or_refused(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    path = tmp_path_factory.getbasetemp() / "any.yaml"
    path.write_text(text)
    try:
        load_yaml(path, Drawing)
    except InputError as error:
        assert "\n" not in str(error)


@pytest.mark.parametrize(
    ("number", "got"),
    [
        ("1e300", "1e+300"),
        ("-2e30", "-2e+30"),
        ("1" + "0" * 300, "a whole number of 997 bits"),
        ("0x" + "f" * 100_000, "a whole number of 400000 bits"),
    ],
)
def test_numbers_that_would_overflow_are_refused(tmp_path: Path, number: str, got: str) -> None:
    path = tmp_path / "a.yaml"
    path.write_text(f"title: a\nshapes:\n  - {{kind: circle, radius: {number}}}\n")
    with pytest.raises(InputError) as raised:
        load_yaml(path, Drawing)
    rule = f"numbers must be from -1e+30 to 1e+30 (got {got})"
    assert str(raised.value) == f"{path}:3: shapes[0].radius: {rule}"


@pytest.mark.parametrize(
    "text", ["cell", "./a-b/c_1.d", "../x", "cell #2", ".5", ".inf", "007", "1e5", "Yes", "~", "a: b", "", "Zürich"]
)
def test_a_written_text_is_read_as_the_same_text(text: str) -> None:
    assert YAML(typ="safe").load(f"{{name: {yaml_scalar(text)}}}") == {"name": text}
