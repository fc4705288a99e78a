from netem.core.packet_rows import NETEM_PACKET, PACKET_HEAD_BYTES
from noack.protocol import wire_format
from noack.protocol.record_tables import OWNER, SENSOR_ACKNOWLEDGEMENT, tables
from noack.protocol.roles import LOOP_ROLES


def test_every_table_is_written_by_one_process_of_the_loop() -> None:
    assert set(tables(1, 1, acknowledged=True)) == set(OWNER)
    assert set(tables(1, 1)) == set(OWNER) - {SENSOR_ACKNOWLEDGEMENT}
    assert set(OWNER.values()) == set(LOOP_ROLES)


def test_the_recorded_head_of_a_datagram_is_its_whole_header() -> None:
    """The record shows which update was dropped, although the network does not read payloads."""
    assert wire_format.HEADER_BYTES == PACKET_HEAD_BYTES
    assert tables(1, 1)[NETEM_PACKET]["head"].itemsize == PACKET_HEAD_BYTES
