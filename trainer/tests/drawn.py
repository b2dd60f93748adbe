"""What a rerun recording holds."""

from __future__ import annotations

from rerun.chunk import RrdReader


def values_in(rrd):
    """What was logged, by entity: a list of (step or None, value)."""
    found: dict[str, list[tuple[int | None, object]]] = {}
    for chunk in RrdReader(str(rrd)).stream().to_chunks():
        columns = chunk.to_record_batch().to_pydict()
        steps = columns.get("step", [None] * chunk.num_rows)
        for name, values in columns.items():
            if name in ("Scalars:scalars", "StateChange:state"):
                rows = found.setdefault(chunk.entity_path, [])
                rows += [(step, value[0]) for step, value in zip(steps, values, strict=True)]
            elif name not in ("step", "rerun.controls.RowId"):
                found.setdefault(chunk.entity_path, [])
    return {path: sorted(rows, key=lambda row: row[0] or 0) for path, rows in found.items()}
