"""What an owner may say of needle and workspace, and what is refused."""

from collections.abc import Iterator

import pytest
from pydantic import BaseModel, ValidationError

from needletrack.tracking.needle import Needle, Range, Workspace
from needletrack.tracking.parameters import TrackingParameters


def fields(model: type[BaseModel], path: str = "") -> Iterator[tuple[str, str | None, type]]:
    """(dotted name, description, type) of every parameter, those of nested models too."""
    for name, field in model.model_fields.items():
        kind = field.annotation
        yield f"{path}{name}", field.description, kind if isinstance(kind, type) else object
        if isinstance(kind, type) and issubclass(kind, BaseModel) and kind is not Range:
            yield from fields(kind, f"{path}{name}.")


def models(model: type[BaseModel]) -> Iterator[type[BaseModel]]:
    yield model
    for field in model.model_fields.values():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from models(field.annotation)


def test_every_parameter_says_what_it_means() -> None:
    found = list(fields(TrackingParameters))
    assert len(found) > 40
    assert [name for name, description, _ in found if not description] == []


def test_lengths_angles_and_pixels_say_their_unit() -> None:
    units = (
        "_mm",
        "_mm2",
        "_mm_s",
        "_px",
        "_deg",
        "_gray",
        "_noise",
        "_share",
        "_rounds",
        "_candidates",
        "_contrast",
        "_misfit",
        "_odds",
    )
    plain = {"gates.min_coverage", "workspace.entry_side"}
    for name, _, kind in fields(TrackingParameters):
        if not issubclass(kind, BaseModel) or kind is Range:
            assert name.endswith(units) or name in plain, name


@pytest.mark.parametrize("model", dict.fromkeys(models(TrackingParameters)), ids=lambda model: model.__name__)
def test_models_are_frozen_and_refuse_what_they_do_not_know(model: type[BaseModel]) -> None:
    whole = model(min=0.0, max=1.0) if model is Range else model()
    name = next(iter(model.model_fields))
    with pytest.raises(ValidationError, match="frozen"):
        setattr(whole, name, getattr(whole, name))
    with pytest.raises(ValidationError, match="Extra inputs"):
        model.model_validate(whole.model_dump() | {"colour": "blue"})


@pytest.mark.parametrize("ends", [(2.0, 1.0), (1.0, 1.0), (float("nan"), 1.0)])
def test_a_range_runs_upwards(ends: tuple[float, float]) -> None:
    with pytest.raises(ValidationError, match="is not below"):
        Range(min=ends[0], max=ends[1])


def test_a_needles_limits_are_in_order() -> None:
    one_type = Needle(min_diameter_mm=0.9, max_diameter_mm=0.9)
    assert one_type.min_diameter_mm == one_type.max_diameter_mm
    with pytest.raises(ValidationError, match="min_diameter_mm is above max_diameter_mm"):
        Needle(min_diameter_mm=1.3)
    with pytest.raises(ValidationError, match="min_length_mm is not below max_length_mm"):
        Needle(min_length_mm=200.0)


@pytest.mark.parametrize("name", ["min_diameter_mm", "max_diameter_mm", "min_length_mm", "max_length_mm"])
@pytest.mark.parametrize("value", [0.0, -1.0])
def test_lengths_are_positive(name: str, value: float) -> None:
    with pytest.raises(ValidationError, match="greater than 0"):
        Needle.model_validate({name: value})


def test_only_sides_of_the_image_can_be_entered() -> None:
    assert Workspace(entry_side="top").entry_side == "top"
    with pytest.raises(ValidationError, match="entry_side"):
        Workspace.model_validate({"entry_side": "above"})


@pytest.mark.parametrize("share", [-0.01, 1.01])
def test_shares_lie_between_none_and_all(share: float) -> None:
    for name in ("min_coverage", "max_epipolar_share"):
        with pytest.raises(ValidationError, match=name):
            TrackingParameters.model_validate({"gates": {name: share}})


def test_a_part_may_be_given_and_the_rest_keeps_its_defaults() -> None:
    given = TrackingParameters.model_validate({"needle": {"max_diameter_mm": 0.9}, "gates": {"max_sigma_mm": 0.2}})
    assert given.needle.max_diameter_mm == 0.9
    assert given.gates.max_sigma_mm == 0.2
    default = TrackingParameters()
    assert given.needle.min_diameter_mm == default.needle.min_diameter_mm
    assert given.workspace == default.workspace
    assert TrackingParameters.model_validate(default.model_dump()) == default
