"""What every node of the suite shares: the executor, worker threads, parameters, QoS profiles and diagnostics."""
