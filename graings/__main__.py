"""`python -m graings`: equivalent to the command `graings`."""

from graings.cli.main import main

main()
