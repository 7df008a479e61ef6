"""Importing what a setting names by its dotted path, ``package.module:name``."""

from mo_deepdrive.importing import import_named as import_named
