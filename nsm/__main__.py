"""``python -m nsm`` is the command ``nsm``."""

from nsm.cli import main

if __name__ == "__main__":
    main()
