"""Models' files as a stranger could have changed them."""

import base64
import json
import os
import pickle
import zipfile


def small():
    """Arguments of a small model; algorithms change the dict of the policy's arguments."""
    return dict(policy_kwargs=dict(net_arch=[8]), device="cpu")


class Touch:
    """Writes a file when it is unpickled."""

    def __init__(self, marker):
        self.marker = str(marker)

    def __reduce__(self):
        return os.system, (f"touch {self.marker}",)


def rewrite(source, target, changes=(), data=None):
    """Copy a model's archive with other members, or other JSON values."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as new:
        members = {name: old.read(name) for name in old.namelist()} | dict(changes)
        if data is not None:
            members["data"] = json.dumps(json.loads(members["data"]) | data)
        for name, content in members.items():
            if content is not None:
                new.writestr(name, content)
    return target


def serialized(value):
    """A value as SB3 pickles it into its JSON."""
    return {":type:": "<class 'x'>", ":serialized:": base64.b64encode(pickle.dumps(value)).decode()}
