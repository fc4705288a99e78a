"""The core does nothing that is undefined in C: it runs with ASan and UBSan, in a child process."""

import subprocess

import pytest

from tests.native import sanitized_core

ROOT = sanitized_core.ROOT
PYTEST = ("pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "-s")


def run(*module: str) -> subprocess.CompletedProcess[str]:
    """Run a module in a process that has the core with sanitizers; skip if there can be none."""
    try:
        command, environment = sanitized_core.command(*module)
    except sanitized_core.NoSanitizersError as error:
        pytest.skip(str(error))
    return subprocess.run(
        command, env=environment, cwd=ROOT, capture_output=True, text=True, check=False, timeout=500
    )


TESTS = {
    "tests/native/machines_under_sanitizers.py": (),
    "tests/fuzz/test_parsers.py": (
        "test_every_input_of_the_corpus_is_read_or_refused_in_one_line[link_numbers]",
        "test_every_input_of_the_corpus_is_read_or_refused_in_one_line[wire]",
        "test_inputs_near_the_corpus_are_read_or_refused_in_one_line[link_numbers]",
        "test_inputs_near_the_corpus_are_read_or_refused_in_one_line[wire]",
    ),
    "tests/netem/capture/test_pcapng.py": (
        "test_an_independent_reader_finds_what_was_written", "test_the_largest_datagram_fits",
        "test_events_of_any_numbers_are_refused_or_written",
        "test_events_that_overflow_the_queue_are_reported_missing",
    ),
    "tests/noack/protocol/test_wire_format.py": (
        "test_encoded_messages_decode_unchanged", "test_any_flipped_bit_is_rejected",
        "test_a_key_or_a_vector_of_another_size_is_refused",
        "test_only_the_first_of_several_faults_is_counted",
    ),
    "tests/netem/test_link.py": (
        "test_it_does_what_the_plain_network_does", "test_numbers_of_no_network_are_refused",
        "test_a_queue_that_cannot_be_served_in_time",
    ),
    "tests/netem/test_mansd.py": (
        "test_a_restarted_link_keeps_the_guarantee_behind_any_history[mansd 2 recover 4]",
        "test_a_restarted_link_keeps_the_guarantee_behind_any_history[atmost 3 in 10]",
    ),
    "tests/cosim/simulation/test_event_order.py": (
        "test_a_scripted_network", "test_loops_of_different_sizes_on_one_network",
        "test_numbers_of_no_simulation_are_refused",
    ),
    "tests/cosim/simulation/test_several_loops.py": (
        "test_the_first_loop_is_the_run_without_loops[delay1-ack]",
        "test_the_guarantee_holds_per_loop_when_the_shared_queue_overflows",
        "test_a_replay_is_exact_and_finds_a_changed_bit",
        "test_updates_report_their_errors_to_a_queue_that_chooses_by_them",
    ),
    "tests/cosim/analysis/test_replay.py": (
        "test_a_run_is_replayed_bit_for_bit", "test_ticks_after_the_runs_end_are_not_made",
        "test_a_recorded_measurement_after_the_runs_end_is_not_taken",
        "test_an_update_before_the_first_tick_of_a_restarted_controller_is_replayed[True]",
        "test_a_record_with_any_numbers_is_replayed",
    ),
    "tests/cosim/analysis/adversary/test_worst_patterns.py": (
        "test_a_pattern_makes_the_run_of_the_machines[fast ticks]",
        "test_a_pattern_makes_the_run_of_the_machines[disturbed]",
        "test_a_pattern_makes_the_run_of_the_machines[observed]",
        "test_causes_that_end_too_early_are_refused",
    ),
    "tests/noack/runtime/test_live_driver.py": (
        "test_datagrams_that_the_kernel_passes_together_are_handled_one_by_one[40]",
        "test_messages_of_loops_that_tick_together_are_sent_together",
        "test_messages_are_handled_in_order_and_answered[1-True]",
        "test_messages_are_handled_in_order_and_answered[3-False]",
        "test_ticks_are_done_in_order_and_never_early[controller-1000000-20]",
        "test_numbers_that_it_cannot_act_on_are_refused", "test_what_cannot_be_sent_is_counted",
        "test_acknowledgements_have_a_socket_and_counters_of_their_own",
    ),
    "tests/noack/runtime/test_peer_sockets.py": (
        "test_a_flood_displaces_no_peer_datagram_and_all_are_counted",
        "test_addresses_survive_formatting_and_parsing",
        "test_many_sources_take_bounded_memory_and_a_short_report",
    ),
    "tests/cosim/output/export/test_fmu_export.py": (
        "test_a_run_is_that_of_a_simulation[bursts, delays, copies and damage]",
        "test_instances_are_separate_and_can_begin_or_go_on_again",
        "test_what_is_called_at_the_wrong_time_is_an_error",
        "test_packets_that_no_run_has_are_not_used", "test_resources_that_are_damaged_give_one_line",
    ),
}  # fmt: skip
"""Of each file, the tests that reach other parts of the core; none: all."""


def test_these_tests_run_clean() -> None:
    """One process for all of them: with sanitizers, its start takes as long as many tests."""
    names = [f"{file}::{name}" for file, tests in TESTS.items() for name in tests]
    whole = [file for file, tests in TESTS.items() if not tests]
    done = run(*PYTEST, *whole, *names)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[:4000]
