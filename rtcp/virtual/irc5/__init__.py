"""A virtual ABB IRC5: up to four mechanical units that speak EGM. Degrees, mm and s inside, as in ABB's manuals."""
