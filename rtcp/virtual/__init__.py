"""The virtual segment: EtherCAT slaves in software, over a virtual cable or stepped in process."""
