"""Many vehicles at one router: real edge runtimes over TLS; simulators that only send."""
