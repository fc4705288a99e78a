"""Check of a machine: real-time settings, timers, ports, disk.

:mod:`cosim.doctor.machine_measures` measures, with separate processes (:mod:`cosim.doctor.probe`);
:mod:`cosim.doctor.findings` derives the findings from the measurements and prints them.
"""
