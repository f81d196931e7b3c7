"""Mathematics of six-axis arms under the modified (Craig) Denavit-Hartenberg convention."""
