"""Shapes and types of annotated functions are checked while tests run (and only then: the hook breaks compilation)."""

from jaxtyping import install_import_hook

install_import_hook("nerfdiff", "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))")
