"""Commands beside the tasks: ``nsm WORD ...``, each a module with ``main(words)``."""
