"""The segment in software: slaves that speak EtherCAT frames, over a virtual cable or stepped without one."""
