"""Real-time control platform for EtherCAT robot arms."""

__version__ = "0.1.0"
