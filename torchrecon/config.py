"""Every stage's parameters in one place, filled from a YAML file that may name only what exists."""

from __future__ import annotations

import dataclasses
import difflib
import os
import typing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import yaml

from torchrecon.contour import MoverParams
from torchrecon.depth import BilateralParams, BoxParams, SampleParams
from torchrecon.errors import ReconError
from torchrecon.features import TrackerParams

T = TypeVar("T")


__all__ = ["Config", "DepthParams", "from_mapping", "load_config", "to_mapping"]


def from_mapping(cls: type[T], values: Any, where: str = "config") -> T:
    """Fill a (nested) parameter dataclass; an unknown key is an error that names the close ones.

    Example:
        >>> @dataclass(frozen=True)
        ... class Gate:
        ...     radius: float = 3.0
        >>> from_mapping(Gate, {"radius": 5}).radius
        5.0
    """
    if not isinstance(values, dict):
        raise ReconError(f"{where}: {values!r} is not a mapping of parameter names to values")
    hints = typing.get_type_hints(cls)
    fields = {f.name: f for f in dataclasses.fields(cls) if f.init}  # type: ignore[arg-type]
    filled: dict[str, Any] = {}
    for key, value in values.items():
        if key not in fields:
            close = difflib.get_close_matches(str(key), fields, n=3) or sorted(fields)
            raise ReconError(f"{where}: unknown key {key!r}; did you mean {', '.join(close)}?")
        filled[key] = _cast(hints[key], value, f"{where}.{key}")
    try:
        return cls(**filled)
    except (TypeError, ValueError) as error:
        raise ReconError(f"{where}: {error}") from error


def _cast(hint: Any, value: Any, where: str) -> Any:
    options = typing.get_args(hint)
    if dataclasses.is_dataclass(hint):
        return from_mapping(typing.cast("type[Any]", hint), value, where)
    if typing.get_origin(hint) is typing.Literal:
        if value not in options:
            raise ReconError(f"{where}: {value!r} is not one of {', '.join(map(repr, options))}")
        return value
    if typing.get_origin(hint) is tuple:
        if not isinstance(value, list | tuple) or (options[-1] is not Ellipsis and len(value) != len(options)):
            raise ReconError(f"{where}: {value!r} is not a list of {len(options)} values")
        kinds = [options[0]] * len(value) if options[-1] is Ellipsis else list(options)
        return tuple(_cast(kind, item, where) for kind, item in zip(kinds, value, strict=True))
    if type(None) in options:
        if value is None:
            return None
        return _cast(next(option for option in options if option is not type(None)), value, where)
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if isinstance(hint, type) and (not isinstance(value, hint) or (hint is int and isinstance(value, bool))):
        raise ReconError(f"{where}: {value!r} is not of type {hint.__name__}")
    return value


def to_mapping(config: Any) -> dict[str, Any]:
    """The resolved parameters as plain nested values, ready for YAML or JSON."""
    return dataclasses.asdict(config)


@dataclass(frozen=True)
class DepthParams:
    """Parameters of the depth stages, each documented beside its stage."""

    bilateral: BilateralParams = field(default_factory=BilateralParams)
    box: BoxParams = field(default_factory=BoxParams)
    sample: SampleParams = field(default_factory=lambda: SampleParams(around=2.5))


@dataclass(frozen=True)
class Config:
    """Parameters of the road from a video to tracks; each stage documents its own.

    Attributes:
        tracker: SIFT detection and tracking.
        mover: search for the moving body where no masks are given.
        depth: filtering, range box and sampling of measured depth.
        min_track_frames: frames that a track has to last to count as one.
        min_tracks: tracks of that length below which a clip is refused.
        least_own_motion: pixels by which a track has to move against the background where no masks are given.
    """

    tracker: TrackerParams = field(default_factory=TrackerParams)
    mover: MoverParams = field(default_factory=MoverParams)
    depth: DepthParams = field(default_factory=DepthParams)
    min_track_frames: int = 10
    min_tracks: int = 16
    least_own_motion: float = 3.0


def load_config(path: str | os.PathLike[str] | None) -> Config:
    """Read a YAML file of parameters; None gives the defaults.

    Raises:
        ReconError: no such file, no YAML, an unknown key or a value of the wrong type; names file and key.

    Example:
        >>> load_config(None).min_tracks
        16
    """
    if path is None:
        return Config()
    source = Path(path)
    if not source.is_file():
        raise ReconError(f"{source}: no such file")
    try:
        values = yaml.safe_load(source.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ReconError(f"{source}: is not YAML ({error})") from error
    return from_mapping(Config, {} if values is None else values, str(source))
