-- wrk's script: requests of a file in turn, and what came of it as JSON.
-- wrk ... -s requests.lua URL -- FILE
-- FILE: for each request a line "METHOD PATH CONTENT-TYPE BYTES", and so many bytes of a body.

local bodies, at = {}, 0

function init(args)
  local file = assert(io.open(args[1], "rb"))
  for line in file:lines() do
    local method, path, kind, bytes = line:match("^(%S+) (%S+) (.+) (%d+)$")
    local body = tonumber(bytes) > 0 and file:read(tonumber(bytes)) or nil
    bodies[#bodies + 1] = wrk.format(method, path, {["Content-Type"] = kind}, body)
  end
end

function request()
  at = at % #bodies + 1
  return bodies[at]
end

function done(summary, latency)
  local errors = summary.errors
  io.write(string.format(
    '\n{"requests": %d, "seconds": %.3f, "p50_ms": %.2f, "p95_ms": %.2f, "failed": %d}\n',
    summary.requests, summary.duration / 1e6,
    latency:percentile(50) / 1e3, latency:percentile(95) / 1e3,
    errors.connect + errors.read + errors.write + errors.status + errors.timeout))
end
