"""The commands of ``python -m sb3_por``. What a command needs is imported when it runs, so that ``--help`` is quick."""
