import json
import re
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft202012Validator

from needletrack.errors import PublishError
from needletrack.publish import schema
from needletrack.publish.message import Instant, TrackMessage
from needletrack.records import REASON_MEANING, DropReason, NeedleTrack, Reason, Status

DOCS = Path(__file__).parents[2] / "docs"
PAGE = DOCS / "wire.md"
NAMES = ("track", "status")


def document(name: str, kind: str) -> Any:
    return json.loads((DOCS / "wire" / f"{name}.v1.{kind}.json").read_text(encoding="utf-8"))


def validator(name: str) -> Draft202012Validator:
    Draft202012Validator.check_schema(document(name, "schema"))
    return Draft202012Validator(document(name, "schema"))


def test_the_documents_have_not_drifted() -> None:
    for name, text in schema.documents(PAGE.read_text(encoding="utf-8")):
        path = DOCS / "wire" / name if name else PAGE
        assert path.read_text(encoding="utf-8") == text, f"run `make schema`: {path} is not what the models say"


def test_stale_documents_are_brought_up(tmp_path: Path) -> None:
    page = re.sub(r"(<!-- generated: reasons -->\n).*?(<!-- end -->)", r"\1old\n\2", PAGE.read_text(), flags=re.S)
    (tmp_path / "wire.md").write_text(page, encoding="utf-8")
    schema.write(tmp_path / "wire")
    assert (tmp_path / "wire.md").read_text(encoding="utf-8") == PAGE.read_text(encoding="utf-8")
    written = {path.name for path in (tmp_path / "wire").iterdir()}
    assert written == {f"{name}.v1.{kind}.json" for name in NAMES for kind in ("schema", "example")}


def test_another_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(PublishError, match="name the folder beside the page, docs/wire"):
        schema.write(tmp_path)


@pytest.mark.parametrize("name", NAMES)
def test_the_example_is_valid(name: str) -> None:
    validator(name).validate(document(name, "example"))


@pytest.mark.parametrize("name", NAMES)
def test_every_field_is_required_by_the_schema(name: str) -> None:
    whole = document(name, "schema")
    parts = [whole, *(part for part in whole["$defs"].values() if part["type"] == "object")]
    assert len(parts) > 1
    for part in parts:
        assert set(part["required"]) == set(part["properties"])


def test_a_later_field_and_a_later_reason_pass_the_schema() -> None:
    later = document("track", "example") | {
        "colour": "blue",
        "status": "degraded",
        "reasons": ["bent_by_magic"],
    }
    validator("track").validate(later)


def test_every_table_of_the_page_is_made_from_a_model() -> None:
    named = set(re.findall(r"<!-- generated: ([a-z ]+) -->", PAGE.read_text(encoding="utf-8")))
    assert named == {*schema.TABLES, *schema.ANSWERS, "reasons", "control codes"}


def test_every_kind_of_track_passes_the_schema() -> None:
    track, pair = schema.example_track(points=20)
    stamp = pair.captured_at_ns
    for answer in (
        track,
        NeedleTrack(stamp, Status.DEGRADED, (Reason.TIP_NOT_SEEN,), track.curve),
        NeedleTrack(stamp, Status.INVALID, (Reason.NO_CANDIDATE,)),
    ):
        message = TrackMessage.from_track(
            answer, pair, schema.example_run(), dropped={DropReason.OVERWRITTEN: 1}, published=Instant.now()
        )
        validator("track").validate(json.loads(message.to_json()))


def test_the_page_explains_every_code() -> None:
    page = PAGE.read_text(encoding="utf-8")
    for reason, meaning in REASON_MEANING.items():
        assert f"| `{reason.value}` | {meaning} |" in page
    for drop in DropReason:
        assert f"`{drop.value}`" in page, f"docs/wire.md does not explain {drop.value}"
