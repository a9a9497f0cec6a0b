"""`python -m jaxsr`."""

from jaxsr.cli import main

main()
