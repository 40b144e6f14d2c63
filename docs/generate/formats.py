"""The table of the formats of models, from `splatmill.schema.files.formats`: a part of the page about formats."""

from docs.generate.markdown import code, table

from splatmill.schema.files.formats import MODEL_FORMATS


def page() -> str:
    """The table, without a heading."""
    rows = [
        [code(form.suffix), form.name, _use(form.readable, form.writable), form.loses]
        for form in MODEL_FORMATS.values()
    ]
    return table(["suffix", "format", "Splatmill", "what a model loses in it"], rows)


def _use(readable: bool, writable: bool) -> str:
    return " and ".join(word for word, can in (("reads", readable), ("writes", writable)) if can)
