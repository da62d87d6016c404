"""A griffe extension for what the site's parser of docstrings does not know: Sphinx's roles, and fields of named tuples."""

import re
from typing import Any

import griffe


class DocstringRoles(griffe.Extension):
    """Write ``:func:`name` `` as a link to the documentation of ``name``, and fields of named tuples as attributes."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """Rewrite the docstring of an object that was loaded."""
        if obj.docstring is None:
            return
        text = re.sub(r":\w+:`([\w.]+)`", r"[`\1`][\1]", obj.docstring.value)
        if isinstance(obj, griffe.Class) and "NamedTuple" in map(str, obj.bases):
            text = text.replace(":param ", ":var ")
        obj.docstring.value = text
