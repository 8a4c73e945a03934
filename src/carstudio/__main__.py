"""`python -m carstudio`, which is what torchrun starts."""

from carstudio.cli import main

if __name__ == "__main__":
    main()
