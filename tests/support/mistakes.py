"""What every mistake of a user must end in."""

from __future__ import annotations

GARBAGE = bytes(range(256)) * 8

GOOD = """\
schema_version: 2
constraints: {budget: {rays: 100}}
sensors:
- name: one
  weight: 1.0
  origin_m: {mean: [0.4, 0.0, 0.0]}
  boresight: {azimuth_rad: 3.14, elevation_rad: 0.0}
  field_of_view_rad: {horizontal: 0.2, vertical: 0.25}
  gate_m: {start: 0.25, end: 0.4}
"""


def check_one_clear_message(result, code, place, *words):
    """The message is short, says where and what, is the same in JSON, and the exit code is right."""
    assert result.code == code, result.err
    document = result.json
    assert (document["schema_version"], document["exit_code"]) == (1, code)
    assert document["error"]["message"]
    assert code != 4 or "conflicts" in document["error"]
    assert place in document["error"].get("where", ""), document["error"]
    for word in words:
        assert word in result.err, result.err
    assert "Traceback" not in result.err
    assert len(result.err.strip().splitlines()) <= 4, result.err
    assert len(result.err) < 5000
