"""Shape setting of Nitinol rods by an electric current (docs/shape_setting.md)."""
