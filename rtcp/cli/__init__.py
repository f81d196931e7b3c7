"""The command `rtcp`: one file for each group of commands; `__main__` joins them."""
