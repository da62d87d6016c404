"""Models on the hub: push a run with its card, pull one without running anything that its files hold."""

import os
import re
import shutil
import warnings
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from sb3_por.common.errors import UserError, UserNote, one_line
from sb3_por.common.files import check_writable
from sb3_por.evaluation.environment import make_evaluation_env
from sb3_por.evaluation.loading import find_environment, resolve
from sb3_por.evaluation.model_files import LOADABLE
from sb3_por.evaluation.plain_files import STATISTICS, has_statistics, read_json, save_plain
from sb3_por.evaluation.safe_loading import failing_in_one_line
from sb3_por.runs import folder as files
from sb3_por.runs.folder import read_settings, write_settings
from sb3_por.sharing import card

#: Largest file that is pulled, and largest file of settings
MAX_FILE, MAX_SETTINGS = 2**30, 2**20
#: Files of a card that are pulled as they are
_SHOWN = (card.README, card.RESULTS, card.VIDEO, card.CURVE)
_REPO = re.compile(r"[\w.-]+/[\w.-]+")
_NAME = re.compile(r"[A-Za-z0-9][\w.]*-[A-Za-z0-9][\w.-]*\.zip")


def push(run: str | Path, repo: str, n_episodes: int = 10, private: bool = False) -> str:
    """
    Publish the best model of a run with its card. The user is logged in with ``hf auth login`` or ``HF_TOKEN``.

    :param run: Folder of a run
    :param repo: ``user/name``; made if there is none
    :param n_episodes: Held-out episodes that score it
    :param private: Make the repository private
    :return: Its address
    :raises UserError: If the run has no model, or the hub refuses
    """
    api = _api()
    _check_repo(repo)
    with TemporaryDirectory() as temporary:
        name = card.write_card(run, Path(temporary), repo, n_episodes)
        with _hub_errors(repo):
            url = str(api.create_repo(repo, private=private, exist_ok=True))
            api.upload_folder(repo_id=repo, folder_path=temporary, commit_message=f"Add {name}")
    return url


def pull(repo: str, folder: str | Path, env: str | None = None, unsafe: bool = False) -> Path:
    """
    Fetch a model with its card into a run's folder. What is kept of the model are numbers, names and tensors; nothing that the
    files hold is run.

    :param repo: ``user/name``
    :param folder: New folder, which the commands take as ``--model``
    :param env: Environment id, with the package that registers it if need be; read from the repository by default
    :param unsafe: Keep the model as it is, and pickled statistics, which run code when they are loaded; load nothing
    :return: The folder
    :raises UserError: If the hub refuses, the repository holds no model, or it cannot be loaded safely
    """
    api, folder = _api(), Path(folder)
    _check_repo(repo)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UserError(f"{folder} is there already; give a new folder")
    check_writable(folder.parent)
    with TemporaryDirectory(dir=folder.parent, prefix=".") as temporary:
        fetched, run = Path(temporary) / "fetched", Path(temporary) / "run"
        names = _fetch(api, repo, fetched)
        model = _the_model(repo, names)
        algo, _, env_name = model.removesuffix(".zip").partition("-")
        arguments = _settings(fetched / files.ARGUMENTS)
        named = arguments["env"] if isinstance(arguments.get("env"), str) else env_name
        env_id = find_environment(env or named.rpartition(":")[2])  # a stranger's package is not imported
        own = files.settings_folder(run, env_id)
        own.mkdir(parents=True)
        shutil.move(fetched / model, run / files.BEST_MODEL)
        if not unsafe:  # what it imports is the user's choice
            package = (env or "").rpartition(":")[0]
            arguments = {**arguments, "gym_packages": [package] if package else []}
        for name, settings in (
            (files.ARGUMENTS, arguments),
            (files.HYPERPARAMETERS, _settings(fetched / files.HYPERPARAMETERS)),
        ):
            if settings:
                write_settings(own / name, settings)
        for name in filter(names.__contains__, _SHOWN):
            shutil.move(fetched / name, run / name)
        _take_evaluations(fetched / card.METRICS, run)
        if unsafe:
            if card.PICKLED_STATISTICS in names:
                shutil.move(fetched / card.PICKLED_STATISTICS, own / files.STATISTICS)
        else:
            _make_plain(repo, run, env_id, algo, card.PICKLED_STATISTICS in names)
        if folder.exists():
            folder.rmdir()
        shutil.move(run, folder)
    return folder


def _make_plain(repo: str, run: Path, env_id: str, algo: str, pickled_statistics: bool) -> None:
    """Replace a fetched model by one without pickled code."""
    file = run / files.BEST_MODEL
    try:
        with failing_in_one_line(file):
            if pickled_statistics and not has_statistics(file):
                raise UserError(f"{repo} has its statistics as a pickle, {card.PICKLED_STATISTICS}, alone; --unsafe takes it")
            model, environment = resolve(file, env_id, algo=algo if algo in LOADABLE else None, safe=True)
            make_evaluation_env(model, env_id, **environment).close()  # refuses statistics that are none
            statistics = read_json(file, STATISTICS)
            save_plain(model, file, statistics or None)
    except UserError as error:
        raise UserError(str(error).replace(str(file), f"the model of {repo}")) from error


def _fetch(api: Any, repo: str, folder: Path) -> set[str]:
    """Fetch the files of a card, whose names are known here; returns those that there are."""
    with _hub_errors(repo):
        found = {one.rfilename: one.size or 0 for one in api.model_info(repo, files_metadata=True).siblings or []}
        known = {*_SHOWN, files.ARGUMENTS, files.HYPERPARAMETERS, card.METRICS, card.PICKLED_STATISTICS}
        names = {name for name in found if name in known or _NAME.fullmatch(name)}
        for name in sorted(names):
            limit = MAX_SETTINGS if name.endswith(".yml") else MAX_FILE
            if found[name] > limit:
                raise UserError(f"{name} in {repo} is refused: it has more than {limit >> 20} MiB")
            api.hf_hub_download(repo, name, local_dir=folder)
    return names


def _the_model(repo: str, names: set[str]) -> str:
    models = sorted(name for name in names if name.endswith(".zip") and name != card.METRICS)
    if len(models) != 1:
        raise UserError(f"{repo} holds {len(models)} models named <algo>-<env>.zip instead of one")
    return models[0]


def _take_evaluations(archive: Path, run: Path) -> None:
    """
    Take the evaluations, which ``plot`` draws, from the card's archive; within a bound, and under the name used here. A
    damaged archive costs them alone, and a note.
    """
    if not archive.is_file():
        return
    try:
        with zipfile.ZipFile(archive) as metrics:
            names = metrics.namelist()
            small = files.EVALUATIONS in names and metrics.getinfo(files.EVALUATIONS).file_size <= MAX_FILE
            evaluations = metrics.read(files.EVALUATIONS) if small else None
    # Whatever a damaged archive makes zipfile raise
    except (zipfile.BadZipFile, zlib.error, OSError, RuntimeError, NotImplementedError, EOFError) as error:
        warnings.warn(f"cannot read {archive.name}, so there are no evaluations to plot: {one_line(error)}", UserNote)
        return
    if evaluations is not None:
        (run / files.EVALUATIONS).write_bytes(evaluations)


def _settings(path: Path) -> dict[str, Any]:
    return read_settings(path) if path.is_file() else {}


def _check_repo(repo: str) -> None:
    if not _REPO.fullmatch(repo):
        raise UserError(f"{repo!r} is no repository; give user/name")


def _api() -> Any:
    try:
        from huggingface_hub import HfApi
    except ImportError as error:
        raise UserError("the hub needs huggingface_hub: pip install 'sb3-por[hub]'") from error
    return HfApi(endpoint=os.environ.get("HF_ENDPOINT"), library_name="sb3-por")


@contextmanager
def _hub_errors(repo: str) -> Iterator[None]:
    """
    :raises UserError: If the hub refuses, or cannot be reached
    """
    from huggingface_hub.errors import HfHubHTTPError

    try:
        yield
    except UserError:
        raise
    except (HfHubHTTPError, OSError, ValueError) as error:
        raise UserError(f"the hub does not serve {repo}: {one_line(error)[:300]}") from error
