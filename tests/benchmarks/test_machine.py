"""What a benchmark says of the machine it ran on."""

import platform

import pytest
from benchmarks.machine import Machine


@pytest.mark.parametrize(
    ("release", "told"),
    [
        ("6.1.0-28-amd64", "Linux 6.1"),
        ("6.18.5-somebody-v12", "Linux 6.18"),
        ("5.15.0-1051-aws", "Linux 5.15"),
        ("6-custom", "Linux 6"),
        ("custom", "Linux"),
    ],
)
def test_of_a_kernel_the_version_alone_is_told(monkeypatch: pytest.MonkeyPatch, release: str, told: str) -> None:
    monkeypatch.setattr(platform, "system", lambda: "Linux")
    monkeypatch.setattr(platform, "release", lambda: release)
    said = Machine.here()
    assert said.system == told
    assert release not in said.model_dump_json()
