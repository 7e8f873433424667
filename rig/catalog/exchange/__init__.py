"""Export a catalog to open formats, and import objects from them."""

from rig.catalog.exchange.batch import Gap, ImportBatch, ImportProblem, RejectedFile
from rig.catalog.exchange.bundle import read_bundle, read_unpacked, write_bundle
from rig.catalog.exchange.catalog_reader import read_catalog, read_objects
from rig.catalog.exchange.folder import DEFAULT_PATTERN, read_folder, write_folder
from rig.catalog.exchange.importing import Imported, import_objects, preview_import
from rig.catalog.exchange.plan import Conflict, Plan, plan_import
from rig.catalog.exchange.table import read_table, write_parquet, write_table

__all__ = [
    "DEFAULT_PATTERN",
    "Conflict",
    "Gap",
    "ImportBatch",
    "ImportProblem",
    "Imported",
    "Plan",
    "RejectedFile",
    "import_objects",
    "plan_import",
    "preview_import",
    "read_bundle",
    "read_catalog",
    "read_folder",
    "read_objects",
    "read_table",
    "read_unpacked",
    "write_bundle",
    "write_folder",
    "write_parquet",
    "write_table",
]
