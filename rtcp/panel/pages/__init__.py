"""The pages of the panel, one file each: a function that builds it for one `Page` (`rtcp.panel.page`)."""
