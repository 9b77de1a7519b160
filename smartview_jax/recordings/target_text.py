"""Write the entry `target` of an imported data set: the numbers given, or a template to fill in."""

from pathlib import Path
from typing import NamedTuple

from ..files import dump_yaml, read_yaml
from ..io import TARGETS, read_april_grid, read_target
from ..targets import AbstractTarget, target_to_dict


class TargetText(NamedTuple):
    """The entry `target` of a description.

    Attributes:
        text: in YAML.
        is_template: whether the lengths are only examples, to be replaced by measured ones.
    """

    text: str
    is_template: bool


def target_text(target: AbstractTarget | str | Path) -> TargetText:
    """Return the entry for a target.

    Args:
        target: a target; or the name of a kind, such as `"charuco"`; or a file: a `dataset.yaml`
            (or only its entry `target`), or the `target.yaml` of Kalibr.

    Raises:
        FileNotFoundError: neither a kind nor a file.
        ValueError: the file has no target, or a wrong one.
    """
    if isinstance(target, AbstractTarget):
        return _text_of(target)
    if str(target) in TARGETS:
        return TargetText(f"{TARGETS[str(target)]}\n", True)
    path = Path(target)
    if not path.is_file():
        raise FileNotFoundError(
            f"target: expected one of {', '.join(TARGETS)}, or a file such as dataset.yaml; there "
            f"is no file {path}"
        )
    content = read_yaml(path)
    if "target_type" in content:
        return _text_of(read_april_grid(path))
    entry = content.get("target", content if "kind" in content else None)
    if not isinstance(entry, dict):
        raise ValueError(f"{path}: expected an entry target")
    try:
        return _text_of(read_target(path.parent, entry))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _text_of(target: AbstractTarget) -> TargetText:
    return TargetText(dump_yaml({"target": target_to_dict(target)}), False)
