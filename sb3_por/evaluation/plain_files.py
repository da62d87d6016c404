"""Model files as JSON values and tensors: bounded reading of any SB3 ``.zip``, and writing of files without pickled code."""

import io
import json
import pickletools
import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import stable_baselines3
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_por.common.errors import UserError
from sb3_por.common.files import atomic_write
from sb3_por.common.plain import ATTRIBUTE, describe
from sb3_por.runs import environment

#: Largest size of a member with JSON values, of one with tensors, and most members of an archive
MAX_JSON, MAX_TENSORS, MAX_MEMBERS = 32 * 2**20, 512 * 2**20, 64
#: Members that hold attributes, networks and plain ``VecNormalize`` statistics
DATA, POLICY, STATISTICS = "data", "policy.pth", "vecnormalize.json"
#: Everything that SB3 and ``save_plain`` write
_MEMBER = re.compile(r"data|[\w.]+\.pth|_stable_baselines3_version|system_info\.txt|vecnormalize\.json")
#: Everything that a pickle of tensors names
_KINDS = ("Float", "Double", "Half", "BFloat16", "Long", "Int", "Short", "Char", "Byte", "Bool")
_TENSOR_NAMES = {
    *("collections OrderedDict", "torch._utils _rebuild_tensor_v2", "torch._utils _rebuild_parameter"),
    *(f"torch {kind}Storage" for kind in _KINDS),
}
#: Parameters that only learning needs: the networks of the values, then what an objective that is kept needs as well
_VALUES = re.compile(r"critic(_target)?\.qf\d+\.")
_LEARNING = re.compile(rf"{_VALUES.pattern}|critic_target\.|objective\.")


def read_json(path: Path, member: str = DATA) -> dict[str, Any]:
    """
    :param path: A model's ``.zip``, perhaps a stranger's
    :param member: Member to read
    :return: Its JSON values; empty if there is no such member
    :raises UserError: If the archive or the member is not one that SB3 writes
    """
    with _open(path) as archive:
        if member not in archive.namelist():
            return {}
        values = json.loads(_read(archive, member, MAX_JSON, path))
    if not isinstance(values, dict):
        raise UserError(f"{member} in {path} holds {type(values).__name__} instead of names and values")
    return values


def has_statistics(path: Path) -> bool:
    """Whether a model's ``.zip`` holds plain ``VecNormalize`` statistics."""
    with zipfile.ZipFile(path) as archive:
        return STATISTICS in archive.namelist()


def read_tensors(path: Path) -> dict[str, th.Tensor]:
    """
    :param path: A model's ``.zip``, perhaps a stranger's
    :return: Name -> tensor of its networks, on the CPU
    :raises UserError: If they are not tensors alone, or too large
    """
    with _open(path) as archive:
        inner = _read(archive, POLICY, MAX_TENSORS, path)
    copy, names = io.BytesIO(), []
    with zipfile.ZipFile(io.BytesIO(inner)) as pth, zipfile.ZipFile(copy, "w") as clean:
        if sum(info.file_size for info in pth.infolist()) > MAX_TENSORS:
            raise UserError(f"{POLICY} in {path} unpacks to more than {MAX_TENSORS >> 20} MiB")
        # PyTorch gets what was checked here: its own reader may see other members in an ambiguous archive.
        for info in pth.infolist():
            content = pth.read(info)
            clean.writestr(zipfile.ZipInfo(info.filename), content)
            if info.filename.endswith(".pkl"):
                names += [argument for code, argument, _ in pickletools.genops(content) if "GLOBAL" in code.name]
    if unknown := [str(name) for name in names if name not in _TENSOR_NAMES]:
        raise UserError(f"{POLICY} in {path} is refused: it names {unknown[0]!r:.80}, which is no part of a tensor")
    copy.seek(0)
    tensors = th.load(copy, map_location="cpu", weights_only=True)
    for name, tensor in tensors.items() if isinstance(tensors, dict) else [("it", tensors)]:
        stored = isinstance(tensor, th.Tensor) and tensor.numel() * tensor.element_size() <= tensor.untyped_storage().nbytes()
        if not isinstance(name, str) or not stored:
            raise UserError(f"{POLICY} in {path} is refused: {name!r:.80} is not a tensor with its values")
    return dict(tensors)


def save_plain(model: BaseAlgorithm, path: Path, statistics: dict[str, Any] | None = None) -> None:
    """
    Save what playing and the diagnosis of an order need: description, environment, and networks without those of the values,
    of the target, and of an objective that is not kept; no optimizer, no pickled code. ``load_safe`` reads it, SB3's ``load``
    does not.

    :param model: A model
    :param path: ``.zip`` to write
    :param statistics: ``VecNormalize`` statistics that the model plays with, see ``describe_statistics``
    """
    stored = {name: vars(model)[name] for name in (environment.ATTRIBUTE, "num_timesteps") if name in vars(model)}
    needless = _needless(model.policy)
    tensors = {
        name: tensor.cpu().contiguous() for name, tensor in model.policy.state_dict().items() if not needless.match(name)
    }
    networks = io.BytesIO()
    th.save(tensors, networks)
    with atomic_write(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(DATA, json.dumps({**stored, ATTRIBUTE: describe(model)}, indent=1))
        archive.writestr(POLICY, networks.getvalue())
        archive.writestr("_stable_baselines3_version", stable_baselines3.__version__)
        if statistics is not None:
            archive.writestr(STATISTICS, json.dumps(statistics))


def may_lack(policy: BasePolicy, names: set[str]) -> bool:
    """Whether all of some missing parameters of a policy are such as ``save_plain`` leaves out."""
    return all(_needless(policy).match(name) for name in names)


def _needless(policy: BasePolicy) -> re.Pattern[str]:
    """What the names of parameters start with that neither playing nor a diagnosis needs."""
    return _VALUES if getattr(getattr(policy, "objective", None), "kept", False) else _LEARNING


def describe_statistics(statistics: VecNormalize) -> dict[str, Any]:
    """
    :param statistics: A wrapper with its running means
    :return: JSON values from which ``normalize`` makes it
    """
    names = ("norm_obs", "clip_obs", "epsilon", "norm_obs_keys")
    means = getattr(statistics, "obs_rms", None) if statistics.norm_obs else None
    per_key = means if isinstance(means, dict) else {"": means} if means is not None else {}
    observations = {key: {"mean": rms.mean.tolist(), "var": rms.var.tolist()} for key, rms in per_key.items()}
    return {**{name: getattr(statistics, name) for name in names}, "observations": observations}


def normalize(env: VecEnv, described: dict[str, Any]) -> VecNormalize:
    """
    :param env: Environments whose observations are to be normalized
    :param described: Of ``describe_statistics``, perhaps a stranger's
    :return: The environments with the statistics fixed, and rewards as they are
    :raises AssertionError: If the statistics have another shape, as ``VecNormalize.load`` does
    :raises UserError: If they are no statistics
    """
    try:
        wrapped = VecNormalize(
            env,
            training=False,
            norm_obs=bool(described["norm_obs"]),
            norm_reward=False,
            clip_obs=float(described["clip_obs"]),
            epsilon=float(described["epsilon"]),
            norm_obs_keys=described["norm_obs_keys"],
        )
        means = wrapped.obs_rms if wrapped.norm_obs else {}
        for key, rms in (means if isinstance(means, dict) else {"": means}).items():
            one = described["observations"][key]
            for name in ("mean", "var"):
                values = np.array(one[name], np.float64)
                assert values.shape == rms.mean.shape, f"statistics of {values.shape} for observations of {rms.mean.shape}"
                setattr(rms, name, values)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise UserError(f"these are no statistics of VecNormalize: {error!r:.100}") from error
    return wrapped


def _open(path: Path) -> zipfile.ZipFile:
    """The archive, if it has only members that SB3 writes."""
    archive = zipfile.ZipFile(path)
    infos = archive.infolist()
    strange = [info.filename for info in infos if not _MEMBER.fullmatch(info.filename)]
    names = {info.filename for info in infos}
    if strange or len(infos) > MAX_MEMBERS or len(names) < len(infos):
        archive.close()
        what = f"the member {strange[0]!r:.80}" if strange else "too many members, or two of one name"
        raise UserError(f"{path} is refused: it has {what}, which no saved model has")
    return archive


def _read(archive: zipfile.ZipFile, member: str, limit: int, path: Path) -> bytes:
    """A member's content; zipfile reads no more than the size that is checked here."""
    if archive.getinfo(member).file_size > limit:
        raise UserError(f"{path} is refused: {member} in it unpacks to more than {limit >> 20} MiB")
    return archive.read(member)
