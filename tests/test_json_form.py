import http
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

from semstab.core.files import read_json, write_json
from semstab.core.json_form import INLINE, from_json, number, to_json
from semstab.errors import DataError


@dataclass(frozen=True)
class Part:
    name: str
    value: float
    pair: tuple[int, float] = (0, 0.0)


@dataclass(frozen=True)
class Sum:
    """Written by its own rule: among the fields of what holds it."""

    value: float

    def json_content(self) -> dict[str, float]:
        return {"total": self.value}

    @classmethod
    def of_json_content(cls, content: Any) -> "Sum":
        return cls(number(content["total"]))


@dataclass(frozen=True)
class Whole:
    level: Literal["high", "low"]
    parts: tuple[Part, ...]
    by_name: Mapping[str, Mapping[str, float]]
    path: Path | None
    first: Part = field(metadata=INLINE)
    sum: Sum = field(metadata=INLINE)
    maybe: Part | None = None
    count: int = 0
    flag: bool = False
    rest: Any = None


WHOLE = Whole(
    level="low", parts=(Part("a", 1.5, (1, 2.0)), Part("b", 2.0)), by_name={"x": {"y": 0.1 + 0.2}},
    path=Path("a") / "b", first=Part("first", 3.0), sum=Sum(7.0), maybe=Part("c", -1.0), count=3, flag=True,
    rest={"any": [1, None]},
)  # fmt: skip


def content() -> Any:
    return json.loads(json.dumps(to_json(WHOLE)))


def test_what_is_written_is_read_back() -> None:
    assert from_json(Whole, content(), "f") == WHOLE
    assert content()["name"] == "first"
    assert content()["total"] == 7.0
    assert "first" not in content()


def test_undefined_numbers_are_null_and_nan_again(tmp_path: Path) -> None:
    path = tmp_path / "part.json"
    write_json(path, [Part("a", math.nan, (1, math.inf)), Part("b", -math.inf)])
    assert read_json(path)[0] == {"name": "a", "value": None, "pair": [1, None]}
    first, second = from_json(tuple[Part, ...], read_json(path), path)  # type: ignore[arg-type]
    assert math.isnan(first.value)
    assert math.isnan(first.pair[1])
    assert math.isnan(second.value)


class Version(str):
    """As torch.__version__ is."""


def test_numpy_and_kinds_of_text_and_of_numbers_become_plain() -> None:
    values = [np.float32(0.5), np.int64(3), np.array([1.0, np.nan]), np.bool_(True), Version("2.1"), http.HTTPStatus.OK]
    written = to_json(values)
    assert written == [0.5, 3, [1.0, None], True, "2.1", 200]
    assert [type(value) for value in written] == [float, int, list, bool, str, int]


def test_a_missing_field_has_its_default_and_an_unknown_one_is_ignored() -> None:
    assert from_json(Part, {"name": "a", "value": 1, "new": []}, "f") == Part("a", 1.0)


def damaged(key: str, value: object) -> Any:
    return content() | {key: value}


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("level", "middle", "level: should be 'high' or 'low', is 'middle'"), ("level", ["low"], "level: should be"),
        ("parts", {"a": 1}, "parts: should be a valid tuple"),
        ("parts", [{"name": "a", "value": 1.0}, {"name": "b"}], "parts[1].value: is missing"),
        ("parts", [{"name": "a", "value": "1"}], "parts[0].value: should be a number, is '1'"),
        ("parts", [{"name": "a", "value": 1.0, "pair": [1]}], "parts[0].pair[1]: is missing"),
        ("parts", [{"name": "a", "value": 10**400}], "parts[0].value: should be a number"),
        ("by_name", {"x": {"y": True}}, "by_name.x.y: should be a number, is True"),
        ("path", 3, "path: is not a valid path"), ("name", 3, "name: should be a valid string"),
        ("total", "x", "sum: should be a number, is 'x'"), ("maybe", 3, "maybe: should be a dictionary"),
        ("count", 3.0, "count: should be a valid integer"), ("count", None, "count: should be a valid integer"),
        ("flag", 1, "flag: should be a valid boolean"),
    ],
)  # fmt: skip
def test_damaged_content_is_one_line_with_file_and_field(key: str, value: object, said: str) -> None:
    with pytest.raises(DataError) as caught:
        from_json(Whole, damaged(key, value), "kept/unit.json")
    line = str(caught.value)
    assert line.startswith("kept/unit.json: ")
    assert said in line
    assert "\n" not in line


@pytest.mark.parametrize("value", [None, 3, [], "text"])
def test_what_is_no_object_is_said(value: object) -> None:
    with pytest.raises(DataError, match="f: content: should be a dictionary"):
        from_json(Part, value, "f")


@pytest.mark.parametrize("bad", ["x\n" * 10_000, [[]] * 10_000, {"k" * 10_000: {}}])
def test_the_line_is_of_bounded_length(bad: object) -> None:
    for cut in (damaged("parts", bad), damaged("by_name", {"k\n" * 10_000: bad})):
        with pytest.raises(DataError) as caught:
            from_json(Whole, cut, "f")
        assert len(str(caught.value)) < 500
        assert "\n" not in str(caught.value)


def test_deep_nesting_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "deep.json"
    path.write_text("[" * 100_000, encoding="utf-8")
    with pytest.raises(DataError, match="not valid JSON") as caught:
        read_json(path)
    assert len(str(caught.value)) < 500
    deep: list[Any] = []
    for _ in range(100_000):
        deep = [deep]
    with pytest.raises(DataError) as caught:
        from_json(Whole, damaged("parts", [deep]), "f")
    assert len(str(caught.value)) < 500


def test_a_type_without_a_json_form_is_a_mistake_of_the_program() -> None:
    with pytest.raises(TypeError, match="set has no JSON form"):
        to_json({1, 2})
