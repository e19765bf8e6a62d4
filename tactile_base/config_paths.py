"""Where configuration files lie: in `config/` of a source tree, else in the installed share folder."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from tactile_base.settings import unknown_name

PACKAGE = "tactile_servoing"


def config_folder() -> Path:
    """The folder that holds scenes, tasks, controllers and parameters.

    It is $TACTILE_CONFIG_DIR where that is set, else `config/` of the source tree that this module lies in,
    else share/tactile_servoing/config of the first prefix in $AMENT_PREFIX_PATH, or of Python itself, that
    has it.

    Raises `FileNotFoundError` with the folders tried, if none exists.
    """
    folders = _candidates()
    for folder in folders:
        if folder.is_dir():
            return folder
    raise FileNotFoundError(f"no configuration folder; tried: {', '.join(map(str, folders))}")


def config_path(name: str) -> Path:
    """The path of a configuration file by its name in the folder: `config_path("scenes/ramp.yaml")`.

    Raises `FileNotFoundError` with the names that exist beside it, if there is no such file.
    """
    path = config_folder() / name
    if not path.is_file():
        beside = (
            sorted(item.name for item in path.parent.glob(f"*{path.suffix}")) if path.parent.is_dir() else []
        )
        raise FileNotFoundError(f"{path.parent}: {unknown_name(path.name, beside)}")
    return path


def packaged_path(name: str) -> Path:
    """As `config_path`; what a folder of the user's own does not have is taken from the package.

    Raises `FileNotFoundError` with the folders tried, if none has it.
    """
    folders = [*_candidates(), *_packaged()]
    for folder in folders:
        if (folder / name).is_file():
            return folder / name
    raise FileNotFoundError(f"no file {name}; tried: {', '.join(dict.fromkeys(map(str, folders)))}")


def named_file(kind: str, name_or_path: str | Path) -> Path:
    """A packaged file by its name, or any by its path (with .yaml): `named_file("scene", "ramp")`.

    `kind` is the folder's name without its s.

    Raises `FileNotFoundError` with the packaged names if there is none.
    """
    text = str(name_or_path)
    if text.endswith((".yaml", ".yml")):
        if not Path(text).is_file():
            raise FileNotFoundError(f"{text}: no such {kind} file")
        return Path(text)
    names = config_names(f"{kind}s")
    if text not in names:
        raise FileNotFoundError(f"{kind}: {unknown_name(text, names)}; or give the path of a .yaml file")
    return config_path(f"{kind}s/{text}.yaml")


def config_names(folder: str, suffix: str = ".yaml") -> list[str]:
    """Names, without suffix, of the files in a folder of the configuration: `config_names("scenes")`."""
    return sorted(path.stem for path in (config_folder() / folder).glob(f"*{suffix}"))


def _candidates() -> list[Path]:
    override = os.environ.get("TACTILE_CONFIG_DIR")
    return [Path(override)] if override else _packaged()


def _packaged() -> list[Path]:
    root = Path(__file__).resolve().parent.parent
    # A `config` beside installed packages is not ours: only a source tree has package.xml there too.
    folders = [root / "config"] if (root / "package.xml").is_file() else []
    prefixes = [*os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep), sys.prefix]
    return folders + [Path(prefix) / "share" / PACKAGE / "config" for prefix in prefixes if prefix]
