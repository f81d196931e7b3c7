"""Extensions of rtcp, one of each; `docs/extending.md` explains them."""
