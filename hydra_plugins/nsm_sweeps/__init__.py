"""Launchers and sweepers of nsm, where Hydra looks for plugins.

Imported at every start of the command: libraries are imported when they are needed.
"""
