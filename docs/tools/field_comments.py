"""A griffe extension: the comment beside or above a field of a class becomes its description on the API page.

In the source, `step_s: float  # duration of a step, seconds` reads better than a list of attributes that
repeats the names. Sphinx reads such comments, griffe does not.
"""

import ast
from typing import Any

from griffe import Attribute, Docstring, Extension


class FieldComments(Extension):
    """Adds the descriptions."""

    def on_attribute_instance(self, *, node: ast.AST, attr: Attribute, **_: Any) -> None:
        """Describe one field."""
        is_field = isinstance(node, ast.AnnAssign) and attr.parent is not None and attr.parent.is_class
        if not is_field or attr.docstring is not None or attr.lineno is None or attr.endlineno is None:
            return
        lines = attr.parent.module.filepath.read_text("utf-8").splitlines()
        _, hash_, beside = lines[attr.endlineno - 1].partition("  # ")
        above = []
        for line in reversed(lines[: attr.lineno - 1]):
            if not line.strip().startswith("# "):
                break
            above.insert(0, line.strip().removeprefix("# "))
        text = beside if hash_ else " ".join(above)
        if text:
            attr.docstring = Docstring(text[0].upper() + text[1:], parent=attr)
