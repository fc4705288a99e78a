-- Wireshark dissector of noack's wire format, versions 1 and 2 (docs/wire.md).
--
--   wireshark -X lua_script:docs/noack.lua -r capture.pcapng
--
-- It finds the datagrams by their form, whatever their ports, and verifies no tag: it has no key.

local MAGIC, VERSION, ENCRYPTED_VERSION = "NA", 1, 2
local HEADER_BYTES, TAG_BYTES = 32, 16
local MAX_DIMENSION = 64
local FLOWS = { [1] = "measurement", [2] = "update", [3] = "actuation", [4] = "acknowledgement" }
local ACKNOWLEDGEMENT = 4
local NS = Int64(1000000000)

local noack = Proto("noack", "noack")

local f = {
    magic = ProtoField.string("noack.magic", "Magic"),
    version = ProtoField.uint8("noack.version", "Version"),
    flow = ProtoField.uint8("noack.flow", "Flow", base.DEC, FLOWS),
    dimension = ProtoField.uint8("noack.dimension", "Dimension"),
    error_level = ProtoField.uint8("noack.error_level", "Error level"),
    loop = ProtoField.uint16("noack.loop", "Loop"),
    run_id = ProtoField.uint64("noack.run_id", "Run id", base.HEX),
    sequence = ProtoField.uint64("noack.sequence", "Sequence number"),
    t_ns = ProtoField.int64("noack.t_ns", "Event time (ns)"),
    vector = ProtoField.double("noack.vector", "Vector"),
    encrypted = ProtoField.bytes("noack.encrypted", "Encrypted vector"),
    tag = ProtoField.bytes("noack.tag", "Tag"),
}
noack.fields = f

local e = {
    version = ProtoExpert.new(
        "noack.version.unknown", "Unknown version", expert.group.PROTOCOL, expert.severity.WARN),
    flow = ProtoExpert.new(
        "noack.flow.unknown", "Unknown flow", expert.group.PROTOCOL, expert.severity.WARN),
    length = ProtoExpert.new(
        "noack.length.wrong", "Length does not fit the dimension",
        expert.group.MALFORMED, expert.severity.ERROR),
}
noack.experts = e

local function datagram_bytes(dimension)
    return HEADER_BYTES + 8 * dimension + TAG_BYTES
end

-- "1.234" of 1234000000 ns
local function seconds(t_ns)
    local sign = ""
    local whole, rest = t_ns / NS, t_ns % NS
    if t_ns < Int64(0) then
        sign = "-"
    end
    -- Quotient and remainder are cut towards 0.
    local text = string.format(
        "%s%s.%09d", sign, tostring(whole):gsub("-", ""), math.abs(rest:tonumber()))
    return (text:gsub("0+$", ""):gsub("%.$", ""))
end

function noack.dissector(tvb, pinfo, tree)
    if tvb:len() < HEADER_BYTES or tvb(0, 2):string() ~= MAGIC then
        return 0
    end
    local version, flow = tvb(2, 1):uint(), tvb(3, 1):uint()
    local dimension = tvb(4, 1):uint()
    local least = flow == ACKNOWLEDGEMENT and 0 or 1
    local fits = dimension >= least and dimension <= MAX_DIMENSION
        and tvb:reported_len() == datagram_bytes(dimension)

    local root = tree:add(noack, tvb())
    root:add(f.magic, tvb(0, 2))
    local version_item = root:add(f.version, tvb(2, 1))
    local flow_item = root:add(f.flow, tvb(3, 1))
    local dimension_item = root:add(f.dimension, tvb(4, 1))
    root:add(f.error_level, tvb(5, 1))
    root:add_le(f.loop, tvb(6, 2))
    root:add_le(f.run_id, tvb(8, 8))
    root:add_le(f.sequence, tvb(16, 8))
    root:add_le(f.t_ns, tvb(24, 8))

    local name = FLOWS[flow] or ("flow " .. flow)
    local info = string.format(
        "%s #%s t=%s s", name, tostring(tvb(16, 8):le_uint64()), seconds(tvb(24, 8):le_int64()))
    pinfo.cols.protocol = "noack"
    pinfo.cols.info = info
    root:append_text(", " .. info)

    if version ~= VERSION and version ~= ENCRYPTED_VERSION then
        version_item:add_proto_expert_info(e.version)
    end
    if not FLOWS[flow] then
        flow_item:add_proto_expert_info(e.flow)
    end
    if not fits then
        dimension_item:add_proto_expert_info(e.length)
        return tvb:len()
    end
    -- A capture may hold less than there was.
    local whole = tvb:len() == datagram_bytes(dimension)
    local first_readable = HEADER_BYTES
    if version == ENCRYPTED_VERSION then
        first_readable = datagram_bytes(dimension)  -- nothing
        if whole and dimension > 0 then
            root:add(f.encrypted, tvb(HEADER_BYTES, 8 * dimension))
        end
    end
    for offset = first_readable, HEADER_BYTES + 8 * (dimension - 1), 8 do
        if tvb:len() >= offset + 8 then
            root:add_le(f.vector, tvb(offset, 8))
        end
    end
    if whole then
        root:add(f.tag, tvb(HEADER_BYTES + 8 * dimension, TAG_BYTES))
    end
    return tvb:len()
end

-- One flipped bit spoils at most one of the two signs, and what netem corrupted is worth seeing.
local function heuristic(tvb, pinfo, tree)
    if tvb:len() < HEADER_BYTES or tvb(0, 2):string() ~= MAGIC then
        return false
    end
    local version = tvb(2, 1):uint()
    local known = (version == VERSION or version == ENCRYPTED_VERSION)
        and FLOWS[tvb(3, 1):uint()] ~= nil
    local sized = tvb:reported_len() == datagram_bytes(tvb(4, 1):uint())
    if not (known or sized) then
        return false
    end
    noack.dissector(tvb, pinfo, tree)
    return true
end

noack:register_heuristic("udp", heuristic)
DissectorTable.get("udp.port"):add_for_decode_as(noack)
