"""One TOML file, the environment above it, and messages that say what to change."""

import os
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import to_jsonable_python

from needletrack.config import Config, load_config
from needletrack.errors import ConfigError
from needletrack.tracking.needle import Range

DEFAULT_TOML = Path(__file__).parents[1] / "config" / "default.toml"


@pytest.fixture(autouse=True)
def _no_overrides(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in os.environ if name.upper().startswith("NEEDLETRACK_")]:
        monkeypatch.delenv(name)


def written(folder: Path, text: str) -> Path:
    path = folder / "rig-room.toml"
    path.write_text(text, encoding="utf-8")
    return path


def keys_of(model: BaseModel, table: str = "") -> Iterator[tuple[str, str, FieldInfo, Any]]:
    """(table, key, field, default) of every key of a configuration that is no table itself."""
    for name, field in type(model).model_fields.items():
        value = getattr(model, name)
        if isinstance(value, BaseModel) and not isinstance(value, Range):
            yield from keys_of(value, f"{table}.{name}".removeprefix("."))
        else:
            yield table, name, field, value


ALL_KEYS = list(keys_of(Config()))


def as_toml(value: Any) -> str:
    if value is None:
        return '""'
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {as_toml(inner)}" for key, inner in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(as_toml, value)) + "]"
    return {True: "true", False: "false"}[value] if isinstance(value, bool) else repr(value).replace("'", '"')


def described_in_default_toml() -> dict[tuple[str, str], str]:
    """The comment above each key of config/default.toml, by table and key."""
    comments: dict[tuple[str, str], str] = {}
    table, comment = "", []
    for line in DEFAULT_TOML.read_text(encoding="utf-8").splitlines():
        if line.startswith("#"):
            comment.append(line.removeprefix("#").strip())
            continue
        if line.startswith("["):
            table = line.strip("[]")
        elif "=" in line and not line.startswith((" ", "]", "}")):
            comments[table, line.split("=")[0].strip()] = " ".join(comment)
        comment = []
    return comments


@pytest.mark.parametrize(("table", "key", "field", "default"), ALL_KEYS, ids=[f"{t}.{k}" for t, k, *_ in ALL_KEYS])
def test_default_toml_holds_every_key_with_its_default_and_its_explanation(
    table: str, key: str, field: FieldInfo, default: Any
) -> None:
    assert field.description, f"give the field {key} of [{table}] a description with its unit"
    entry = f"# {field.description}\n{key} = {as_toml(to_jsonable_python(default))}"
    paste = f"config/default.toml needs, below [{table}]:\n{entry}"
    values: Any = tomllib.loads(DEFAULT_TOML.read_text(encoding="utf-8"))
    for part in table.split("."):
        values = values.get(part, {})
    assert key in values, paste
    read = load_config(DEFAULT_TOML)
    for part in table.split("."):
        read = getattr(read, part)
    assert getattr(read, key) == default, paste
    assert field.description in described_in_default_toml()[table, key], paste


def test_default_toml_holds_nothing_else() -> None:
    assert set(described_in_default_toml()) == {(table, key) for table, key, *_ in ALL_KEYS}
    assert load_config(DEFAULT_TOML) == Config() == load_config()


def test_the_documented_file_is_one(tmp_path: Path) -> None:
    text = (DEFAULT_TOML.parents[1] / "docs" / "configuration.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```toml\n(.*?)```", text, re.DOTALL)
    assert load_config(written(tmp_path, example)).rig.path == tmp_path / "rig.yaml"


def test_a_file_changes_what_it_names_and_nothing_else(tmp_path: Path) -> None:
    path = written(tmp_path, '[tracking.needle]\nmax_length_mm = 80\n[publishing]\nconnect = ["tls/router:7447"]')
    config = load_config(path)
    assert config.tracking.needle.max_length_mm == 80.0
    assert config.publishing.connect == ("tls/router:7447",)
    assert config.tracking.needle.min_diameter_mm == Config().tracking.needle.min_diameter_mm
    assert config.publishing.listen == Config().publishing.listen


def test_the_environment_overrides_the_file_key_by_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written(tmp_path, "[tracking.needle]\nmax_length_mm = 80.0\nmin_length_mm = 12.0")
    monkeypatch.setenv("NEEDLETRACK_TRACKING__NEEDLE__MAX_LENGTH_MM", "90")
    monkeypatch.setenv("NEEDLETRACK_TRACKING__WORKSPACE__Z_MM__MAX", "400")
    monkeypatch.setenv("NEEDLETRACK_PUBLISHING__LISTEN", '["tcp/127.0.0.1:0", "tcp/[::1]:0"]')
    config = load_config(path)
    assert config.tracking.needle.max_length_mm == 90.0
    assert config.tracking.needle.min_length_mm == 12.0
    assert config.tracking.workspace.z_mm == Range(min=200.0, max=400.0)
    assert config.publishing.listen == ("tcp/127.0.0.1:0", "tcp/[::1]:0")


def test_a_whole_table_may_come_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NEEDLETRACK_PAIRING", '{"tolerance_us": 250}')
    assert load_config().pairing.tolerance_us == 250.0


def test_a_path_in_the_file_is_relative_to_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    written(tmp_path, '[rig]\npath = "rigs/left-room.yaml"')
    assert load_config(Path("../rig-room.toml")).rig.path == tmp_path / "rigs" / "left-room.yaml"


def test_a_path_in_the_environment_is_relative_to_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    monkeypatch.setenv("NEEDLETRACK_RIG__PATH", "mine.yaml")
    assert load_config(written(tmp_path, '[rig]\npath = "a.yaml"')).rig.path == tmp_path / "elsewhere" / "mine.yaml"


def test_an_absolute_path_stays(tmp_path: Path) -> None:
    assert load_config(written(tmp_path, '[rig]\npath = "/rigs/a.yaml"')).rig.path == Path("/rigs/a.yaml")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "[tracking.needle]\nmin_diamter_mm = 1",
            "unknown key tracking.needle.min_diamter_mm: did you mean tracking.needle.min_diameter_mm?",
        ),
        ("[needle]\nmin_diameter_mm = 1", "unknown key needle: did you mean tracking.needle?"),
        ("[zebra]\n", "unknown key zebra: known here: rig, tracking, drift, pairing, publishing"),
        (
            "[pairing]\ntolerance_us = -1.0",
            "pairing.tolerance_us = -1.0: should be greater than 0 (Greatest difference",
        ),
        ("[pairing]\ntolerance_us = nan", "pairing.tolerance_us = nan: should be"),
        ('[pairing]\ntolerance_us = "soon"', "pairing.tolerance_us = 'soon': should be a valid number"),
        (
            "[publishing]\nheartbeat_s = 3600",
            "publishing.heartbeat_s = 3600: should be less than or equal to 60",
        ),
        (
            '[publishing]\nlisten = ["7447"]',
            "publishing.listen[0] = '7447': is no Zenoh endpoint: protocol/address, e.g. tcp/",
        ),
        ('[publishing]\nkey_prefix = "a//*"', "publishing.key_prefix = 'a//*': is no Zenoh key"),
        ("[tracking.workspace]\nz_mm = {min = 3, max = 2}", "tracking.workspace.z_mm: min 3 is not"),
        ("[tracking.workspace]\nz_mm = {min = 311}", "tracking.workspace.z_mm: min 311 is not below max 310"),
        ("[tracking.workspace]\nz_mm = 3", "tracking.workspace.z_mm = 3: must be a table"),
        ("pairing = 3", "pairing = 3: must be a table"),
        ("[pairing\n", "not a TOML file"),
    ],
)
def test_a_wrong_entry_is_refused_by_file_key_and_value(tmp_path: Path, text: str, message: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(ConfigError, match=re.escape(f"{path}: {message}")):
        load_config(path)


def test_all_wrong_entries_are_told_at_once(tmp_path: Path) -> None:
    path = written(tmp_path, "[pairing]\ntolerance_us = 0\n[publishing]\nheartbeat = 1")
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    first, second = str(caught.value).splitlines()
    assert "pairing.tolerance_us = 0" in first
    assert "unknown key publishing.heartbeat: did you mean publishing.heartbeat_s?" in second


@pytest.mark.parametrize(
    ("variable", "value", "message"),
    [
        (
            "NEEDLETRACK_PAIRING_TOLERANCE_US",
            "1",
            "no such key: did you mean NEEDLETRACK_PAIRING__TOLERANCE_US?",
        ),
        (
            "NEEDLETRACK_NEEDLE__MAX_LENGTH_MM",
            "1",
            "no such key: did you mean NEEDLETRACK_TRACKING__NEEDLE__MAX_LENGTH_MM?",
        ),
        (
            "NEEDLETRACK_PAIRING__TOLERENCE_US",
            "1",
            "no such key: did you mean NEEDLETRACK_PAIRING__TOLERANCE_US?",
        ),
        ("NEEDLETRACK_XYZZY", "1", "no such key"),
        ("NEEDLETRACK_PAIRING__TOLERANCE_US", "0", "pairing.tolerance_us = '0': should be greater than 0"),
        ("NEEDLETRACK_PUBLISHING__CONNECT", "tcp/a:1", "'tcp/a:1': a list or table is written as JSON"),
        ("NEEDLETRACK_PAIRING", '{"tolerence_us": 1}', "unknown key pairing.tolerence_us"),
        ("NEEDLETRACK_TRACKING__NEEDLE__MAX_LENGTH_MM", "3", "min_length_mm is not below max_length_mm"),
    ],
)
def test_a_wrong_variable_is_refused_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variable: str, value: str, message: str
) -> None:
    monkeypatch.setenv(variable, value)
    with pytest.raises(ConfigError, match=f"^environment variable {variable}.*{re.escape(message)}"):
        load_config(written(tmp_path, "[pairing]\ntolerance_us = 1.0"))


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"absent\.toml: cannot read the configuration: No such file"):
        load_config(tmp_path / "absent.toml")


def test_the_digest_follows_the_values_and_not_their_place(tmp_path: Path) -> None:
    same = load_config(written(tmp_path, '[pairing]\ntolerance_us = 1000\n[rig]\npath = "mine.yaml"'))
    assert same.digest == Config().digest
    assert re.fullmatch("[0-9a-f]{12}", same.digest)
    assert load_config(written(tmp_path, "[pairing]\ntolerance_us = 999")).digest != Config().digest


def test_the_configuration_cannot_be_changed_behind_its_digest() -> None:
    with pytest.raises(ValueError, match="frozen"):
        setattr(Config().pairing, "tolerance_us", 5.0)  # noqa: B010


NEEDLES = """
[tracking.needle]
max_diameter_mm = 2.0
[[control.needles]]
name = "16g"
min_diameter_mm = 1.6
[[control.needles]]
name = "22g"
max_diameter_mm = 0.8
max_length_mm = 60.0
tip_tapers_mm = [0.0]
"""


def test_a_needle_type_is_the_configured_needle_but_for_what_it_says(tmp_path: Path) -> None:
    config = load_config(written(tmp_path, NEEDLES))
    thick, thin = config.with_needle("16g"), config.with_needle("22g")
    assert (thick.tracking.needle.min_diameter_mm, thick.tracking.needle.max_diameter_mm) == (1.6, 2.0)
    assert thin.tracking.needle.model_dump() == {
        **config.tracking.needle.model_dump(), "max_diameter_mm": 0.8, "max_length_mm": 60.0, "tip_tapers_mm": (0.0,),
    }  # fmt: skip
    assert config.with_needle("default") == config
    # What a track was made with is what its digest says, whatever else could have been chosen.
    assert len({config.digest, thick.digest, thin.digest}) == 3
    alone = load_config(written(tmp_path, "[tracking.needle]\nmin_diameter_mm = 1.6\nmax_diameter_mm = 2.0"))
    assert thick.digest == alone.digest
    # From any of them the others can be chosen, and a recording's copy can be read.
    again = Config.model_validate_json(thick.model_dump_json())
    assert again.with_needle("22g").digest == thin.digest
    with pytest.raises(
        ConfigError, match=r"no needle '18g' in control\.needles of the configuration: there are default"
    ):
        config.with_needle("18g")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ('name = "default"', "is the needle of [tracking.needle]: choose another name"),
        ('name = "a b"', "control.needles[0].name = 'a b'"),
        ("min_diameter_mm = 1.0", "control.needles[0].name is missing"),
        ('name = "x"\nmin_diameter_mm = 3.0', "x, with what it leaves to tracking.needle: min_diameter_mm is above"),
        ('name = "x"\ndiameter_mm = 3.0', "unknown key control.needles[0].diameter_mm: did you mean"),
        ('name = "x"\n[[control.needles]]\nname = "x"', "needles: x twice"),
    ],
)
def test_a_needle_type_that_cannot_be_is_refused(tmp_path: Path, text: str, told: str) -> None:
    with pytest.raises(ConfigError) as refused:
        load_config(written(tmp_path, f"[[control.needles]]\n{text}"))
    assert told in str(refused.value)


def test_what_could_be_asked_of_the_daemon_is_not_in_the_digest(tmp_path: Path) -> None:
    config = load_config(written(tmp_path, '[control]\nenabled = true\ntoken_file = "secret"\nsnapshot_folder = "s"'))
    assert config.digest == Config().digest
    assert (config.control.token_file, config.control.snapshot_folder) == (tmp_path / "secret", tmp_path / "s")


def test_an_unknown_key_of_any_length_is_named_in_short(tmp_path: Path) -> None:
    path = tmp_path / "needletrack.toml"
    path.write_text(f"{'k' * 5000} = 1\n")
    with pytest.raises(ConfigError, match="unknown key kkk") as refused:
        load_config(path)
    assert len(str(refused.value)) < 500 + len(str(path))
