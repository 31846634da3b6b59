"""The claims of the paper: what each compares, the rules that test it, and its finding."""
