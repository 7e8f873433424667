"""Templates of pages."""

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined


def environment(*packages: str, folder: str = ".") -> Environment:
    """Return the environment of the templates in the ``folder`` of each package.

    It escapes all values. A value that is missing is an error.
    """
    return Environment(
        loader=ChoiceLoader([PackageLoader(package, folder) for package in packages]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
