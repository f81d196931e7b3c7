"""A virtual ABB IRC5: up to four mechanical units with EGM. Units inside are degrees, mm and s, as in ABB's manuals."""
