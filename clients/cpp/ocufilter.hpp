// Client of the filter service for C++17.  Protocol: filter_service/PROTOCOL.md.
//
//     ocufilter::Client client("tcp://127.0.0.1:5577");
//     const auto camera = ocufilter::Camera::from_fov(50.0, 480, 270);
//     client.set_profile({R"({"kind": "preset", "name": "keratoconus"})", {camera}});
//     ocufilter::Frame frame;
//     frame.views = {{camera, color, depth_m}};  // vectors of std::uint8_t and float
//     const ocufilter::Result seen = client.filter(frame);
//
// `filter` sends one frame and waits for the result.  `submit` and `poll` are for live streams:
// at most `max_in_flight` frames are unanswered, and of the others the client keeps only the
// newest.  `poll` returns each submitted frame once, as Result, Dropped or Error.  After a
// restart of the service, the client reconnects and sends its profiles again.
//
// A client is used by one thread at a time and has no thread of its own: call `poll` every few
// seconds.  Requires cppzmq 4.7 and msgpack-cxx 4; link with -lzmq.  The structs of frames,
// profiles and replies are in ocufilter_messages.hpp.

#pragma once

#include <algorithm>
#include <cerrno>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <deque>
#include <iterator>
#include <map>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <utility>
#include <variant>
#include <vector>

#include <msgpack.hpp>
#include <zmq.hpp>

#include "ocufilter_messages.hpp"

namespace ocufilter {

// A session with the filter service.  Methods throw FilterError for an error of the service, a
// malformed reply, or no reply in time; std::invalid_argument for an argument that the client
// itself checks; and zmq::error_t for a failure of ZeroMQ.
class Client {
 public:
  // Connect, without waiting for the service.
  explicit Client(const std::string& endpoint, Options options = {})
      : endpoint_(endpoint), options_(std::move(options)) {
    namespace opt = zmq::sockopt;
    socket_.set(opt::linger, 0);
    socket_.set(opt::immediate, true);  // frames queued for an absent service would be outdated
    socket_.set(opt::heartbeat_ivl, 500);
    socket_.set(opt::heartbeat_timeout, 2000);
    socket_.set(opt::reconnect_ivl, 50);
    socket_.set(opt::reconnect_ivl_max, 1000);
    socket_.set(opt::maxmsgsize, options_.max_reply_bytes);
    if (options_.key) {
      socket_.set(opt::curve_serverkey, options_.key->server_public);
      socket_.set(opt::curve_publickey, options_.key->client_public);
      socket_.set(opt::curve_secretkey, options_.key->client_secret);
    }
    const int events = ZMQ_EVENT_HANDSHAKE_SUCCEEDED | ZMQ_EVENT_DISCONNECTED | HANDSHAKE_FAILED;
    if (zmq_socket_monitor(socket_.handle(), "inproc://events", events)) throw zmq::error_t();
    monitor_.connect("inproc://events");
    try {
      socket_.connect(endpoint);
    } catch (const zmq::error_t& error) {
      throw std::invalid_argument("endpoint is '" + endpoint + "' (" + error.what() +
                                  "); expected a form such as tcp://127.0.0.1:5577");
    }
  }

  Client(const Client&) = delete;
  Client& operator=(const Client&) = delete;

  ~Client() {
    try {
      Message bye = message(detail::MapWriter("bye"));
      if (is_up_ && send(bye)) socket_.set(zmq::sockopt::linger, 200);
    } catch (const std::exception&) {
      // Without bye, the session ends after `session_keep_s`; a destructor must not throw.
    }
    zmq_socket_monitor(socket_.handle(), nullptr, 0);
  }

  // Wait until the service replies to hello.
  Welcome hello() {
    return wait_until([this] { return welcome_; }, options_.timeout_s, "a reply to hello");
  }

  // Change the eye, and wait until it is ready for all cameras.  Until then, and if this throws,
  // the service uses the previous eye.
  Ready set_profile(const Profile& profile, double timeout_s = 120.0) {
    if (profile.cameras.empty()) throw std::invalid_argument("cameras is empty; allowed: 1 or 2");
    hello();  // whose time limit is shorter
    const std::int64_t id = request_profile(profile);
    const auto end = after(timeout_s);
    for (int n_missing = 1;;) {
      AnyEvent event = wait_until([&] { return take(&Event::profile_id, id); }, seconds_to(end),
                                  "profile " + std::to_string(id) + " to become ready");
      if (const auto* error = std::get_if<Error>(&event)) throw FilterError(*error);
      // After a lost connection, Accepted arrives again if the profile was sent again.
      if (const auto* reply = std::get_if<Accepted>(&event)) n_missing = reply->n_cameras;
      if (auto* ready = std::get_if<Ready>(&event); ready && --n_missing <= 0) return *ready;
    }
  }

  // Request another eye without waiting; return the profile_id of the events to come.
  std::int64_t request_profile(const Profile& profile) {
    const std::vector<detail::MapWriter> views(profile.cameras.begin(), profile.cameras.end());
    Request request{next_profile_id_++, {}, profile.body};
    detail::MapWriter header("profile");
    header.add("profile_id", request.id).add("eye", profile.eye).add("views", views);
    header.add("settings", detail::MapWriter(profile.settings));
    request.header = header.bytes();
    if (const auto found = requests_.find(profile.eye); found != requests_.end())
      request.previous = found->second.n_missing == 0 ? std::make_shared<Request>(found->second)
                                                      : found->second.previous;
    requests_[profile.eye] = request;
    pump(0.0);
    return request.id;
  }

  // Send one frame and return it filtered.  It is sent again while the service prepares the eye
  // for its camera or state, and after a restart of the service, until `timeout_s` has passed.
  Result filter(const Frame& frame) { return filter(frame, options_.timeout_s); }
  Result filter(const Frame& frame, double timeout_s) {
    const auto end = after(timeout_s);
    for (;;) {
      const std::int64_t id = submit(frame);
      AnyEvent event = wait_until([&] { return take(&Event::frame_id, id); }, seconds_to(end),
                                  "a reply to frame " + std::to_string(id));
      if (auto* result = std::get_if<Result>(&event)) return std::move(*result);
      if (const auto* error = std::get_if<Error>(&event)) throw FilterError(*error);
      const auto& dropped = std::get<Dropped>(event);
      if (seconds_to(end) <= 0.0)
        throw detail::failure("service_timeout", "the service drops the frame: " + dropped.reason);
      const int n_ready = n_ready_;  // Ready ends the pause
      for (const auto next = after(std::min(1e-3 * dropped.retry_after_ms, MAX_PAUSE_S));
           n_ready == n_ready_ && seconds_to(next) > 0.0;)
        pump(seconds_to(next));
    }
  }

  // Submit a frame without waiting; return its frame_id.  If the service is busy, the client
  // keeps the frame in place of one that waits already, which is Dropped as "superseded".
  std::int64_t submit(const Frame& frame) {
    const std::int64_t id = next_frame_id_++;
    const std::vector<detail::MapWriter> views(frame.views.begin(), frame.views.end());
    detail::MapWriter header("frame");
    header.add("frame_id", id).add("views", views);
    header.add("pupil_diameter_mm", frame.pupil_diameter_mm).add("focus_dpt", frame.focus_dpt);
    header.add("gaze_deg", frame.gaze_deg).add("output", detail::MapWriter(frame.output));
    header.add("display_time_ns", frame.display_time_ns);
    header.add("options", detail::MapWriter(frame.options));
    Message parts = message(header);
    for (const View& view : frame.views) {
      const bool has_hidden = view.hidden_color.data != nullptr;
      append(parts, view, "color", view.color, 3 * detail::bytes_of(view.color_type));
      append(parts, view, "depth", view.depth, detail::bytes_of(view.depth_encoding));
      if (!has_hidden) continue;
      append(parts, view, "hidden_color", view.hidden_color, 3 * detail::bytes_of(view.color_type));
      append(parts, view, "hidden_depth", view.hidden_depth, detail::bytes_of(view.depth_encoding));
    }
    if (pending_) drop(pending_->id, "superseded");
    pending_ = Outgoing{id, frame.views.size(), std::move(parts)};
    pump(0.0);
    return id;
  }

  // Return the new events; wait up to `timeout_s` if there are none.
  std::vector<AnyEvent> poll(double timeout_s = 0.0) {
    const auto end = after(timeout_s);
    for (pump(0.0); events_.empty() && !refusal_ && seconds_to(end) > 0.0;) pump(seconds_to(end));
    if (refusal_) events_.push_back(*std::exchange(refusal_, {}));
    std::vector<AnyEvent> found(std::make_move_iterator(events_.begin()),
                                std::make_move_iterator(events_.end()));
    events_.clear();
    return found;
  }

  // Return the number of submitted frames that wait or are unanswered.
  std::size_t n_unanswered() const { return in_flight_.size() + (pending_ ? 1 : 0); }

  // Return the state of the service.
  Pong ping() {
    hello();
    pong_.reset();
    outbox_.push_back(message(detail::MapWriter("ping")));
    return wait_until([this] { return pong_; }, options_.timeout_s, "a reply to ping");
  }

 private:
  using Clock = std::chrono::steady_clock;
  using Message = detail::Message;

  struct Request {  // of a profile
    std::int64_t id;
    std::string header, body;
    bool is_sent = false;
    bool has_crashed = false;
    int n_missing = -1;                            // Ready to come; -1 before Accepted
    std::shared_ptr<const Request> previous = {};  // in use until this one is ready
  };
  struct Outgoing {
    std::int64_t id;
    std::size_t n_views;
    Message parts;
  };

  static constexpr double SILENCE_S = 2.0;  // after which the client sends hello again
  static constexpr double MAX_PAUSE_S = 1.0;
  static constexpr double RETRY_SEND_S = 0.002;  // a new connection accepts messages a bit later
  static constexpr double MAX_WAIT_S = 0.1;
  static constexpr std::size_t MAX_EVENTS = 1000;
  static constexpr int MAX_BROKEN_HANDSHAKES = 5;  // a service that stops may break one
  static constexpr int HANDSHAKE_FAILED = ZMQ_EVENT_HANDSHAKE_FAILED_NO_DETAIL |
                                          ZMQ_EVENT_HANDSHAKE_FAILED_PROTOCOL |
                                          ZMQ_EVENT_HANDSHAKE_FAILED_AUTH;

  static Clock::time_point after(double seconds) {
    return Clock::now() + std::chrono::microseconds(std::llround(1e6 * std::min(seconds, 1e9)));
  }
  static double seconds_to(Clock::time_point end) {
    return std::chrono::duration<double>(end - Clock::now()).count();
  }

  static Message message(const detail::MapWriter& header) {
    Message parts;
    parts.emplace_back(header.bytes());
    return parts;
  }

  void append(Message& parts, const View& view, const char* name, const Bytes& image,
              std::size_t pixel_bytes) const {
    const double expected = 1.0 * view.camera.width_px * view.camera.height_px * pixel_bytes;
    if (image.data == nullptr || static_cast<double>(image.size_bytes) != expected ||
        static_cast<std::int64_t>(image.size_bytes) > max_part_bytes_)
      throw std::invalid_argument(
          std::string(name) + " has " + std::to_string(image.size_bytes) + " bytes; expected " +
          std::to_string(static_cast<std::int64_t>(expected)) + ", and at most " +
          std::to_string(max_part_bytes_));
    parts.emplace_back(image.data, image.size_bytes);
  }

  // Handle messages until `find` returns a value.
  template <class Find>
  typename std::invoke_result_t<Find>::value_type wait_until(Find find, double timeout_s,
                                                             const std::string& what) {
    const auto end = after(timeout_s);
    for (pump(0.0);; pump(seconds_to(end))) {
      if (auto found = find()) return std::move(*found);
      if (refusal_) throw FilterError(*std::exchange(refusal_, {}));
      if (seconds_to(end) <= 0.0)
        throw detail::failure("service_timeout", "timed out waiting for " + what + "; " +
                                                     endpoint_ + (is_up_ ? " is" : " is not") +
                                                     " connected");
    }
  }

  std::optional<AnyEvent> take(std::optional<std::int64_t> Event::*name, std::int64_t id) {
    const auto is_wanted = [=](const AnyEvent& event) {
      return std::visit([=](const Event& about) { return about.*name == id; }, event);
    };
    const auto found = std::find_if(events_.begin(), events_.end(), is_wanted);
    if (found == events_.end()) return {};
    std::optional<AnyEvent> event(std::move(*found));
    events_.erase(found);
    return event;
  }

  // Wait for messages and changes of the connection, handle them, and send what waits.
  void pump(double timeout_s) {
    const double longest_s = is_up_ && !outbox_.empty() ? RETRY_SEND_S : MAX_WAIT_S;
    const double wait_ms = std::ceil(1000.0 * std::clamp(timeout_s, 0.0, longest_s));
    zmq_pollitem_t items[] = {{socket_.handle(), 0, ZMQ_POLLIN, 0},
                              {monitor_.handle(), 0, ZMQ_POLLIN, 0}};
    if (zmq_poll(items, 2, static_cast<long>(wait_ms)) < 0 && zmq_errno() != EINTR)
      throw zmq::error_t();
    while (const auto event = receive(monitor_)) follow(*event);
    while (auto parts = receive(socket_)) handle(std::move(*parts));
    const bool is_reply_due = is_up_ && (!welcome_ || !in_flight_.empty());
    if (is_reply_due && seconds_to(active_) < -SILENCE_S) greet();
    send_waiting();
  }

  static std::optional<Message> receive(zmq::socket_t& socket) {
    Message parts;
    for (bool has_more = true; has_more;) {
      zmq::message_t part;
      const auto flags = parts.empty() ? zmq::recv_flags::dontwait : zmq::recv_flags::none;
      if (!socket.recv(part, flags)) return {};
      has_more = part.more();
      if (parts.size() < detail::MAX_PARTS) parts.push_back(std::move(part));
    }
    return parts;
  }

  void follow(const Message& event) {  // a change of the connection
    std::uint16_t kind = 0;
    std::memcpy(&kind, event[0].data(), std::min(sizeof(kind), event[0].size()));
    if (kind == ZMQ_EVENT_HANDSHAKE_SUCCEEDED) {
      is_up_ = true;
      n_broken_handshakes_ = 0;
      greet();
    } else if (kind == ZMQ_EVENT_DISCONNECTED) {
      is_up_ = false;
      welcome_.reset();
      outbox_.clear();
      lose_frames(0);
      for (auto& [eye, request] : requests_)  // a reply about it may be lost, too
        if (request.n_missing != 0) request.is_sent = false;
    } else {
      const bool may_be_broken = kind == ZMQ_EVENT_HANDSHAKE_FAILED_NO_DETAIL;
      n_broken_handshakes_ += may_be_broken ? 1 : MAX_BROKEN_HANDSHAKES;
      if (n_broken_handshakes_ >= MAX_BROKEN_HANDSHAKES)
        refusal_ = Error{{}, "authentication_failed", "key exchange with " + endpoint_ + " failed",
                         "key", "a file created with `ocufilter keys add NAME`"};
    }
  }

  void greet() {  // on a new connection, or after a silence
    welcome_.reset();
    outbox_.clear();
    detail::MapWriter hello("hello");
    hello.add("client", options_.name).add("session_key", session_key_);
    outbox_.push_back(message(hello));
    active_ = Clock::now();
  }

  void drop(std::int64_t frame_id, const char* reason) {
    events_.push_back(Dropped{{frame_id, {}}, reason});
  }

  void lose_frames(std::size_t n_left) {  // all but the newest
    for (; in_flight_.size() > n_left; in_flight_.erase(in_flight_.begin()))
      drop(in_flight_.begin()->first, "connection_lost");
  }

  // Send a message; return false if the connection cannot accept it now.
  bool send(Message& parts) {
    for (std::size_t i = 0; i < parts.size(); ++i) {
      const auto more = i + 1 < parts.size() ? zmq::send_flags::sndmore : zmq::send_flags::none;
      // If the connection is lost within a message, libzmq discards the rest of it, which must
      // still be sent: the message is lost like the connection.
      if (!socket_.send(parts[i], more | zmq::send_flags::dontwait) && i == 0) return false;
    }
    active_ = Clock::now();
    return true;
  }

  void send_waiting() {
    if (!is_up_) return;
    for (; !outbox_.empty(); outbox_.pop_front())
      if (!send(outbox_.front())) return;
    if (!welcome_) return;
    for (auto& [eye, request] : requests_) {
      if (request.is_sent) continue;
      Message parts;
      parts.emplace_back(request.header);
      parts.emplace_back(request.body);
      if (!send(parts)) return;
      request.is_sent = true;
    }
    const int credit = std::min(options_.max_in_flight, welcome_->credit);
    if (!pending_ || static_cast<int>(in_flight_.size()) >= credit) return;
    if (!send(pending_->parts)) return;
    in_flight_[pending_->id] = pending_->n_views;
    pending_.reset();
  }

  void handle(Message parts) {
    if (parts[0].size() > detail::MAX_HEADER_BYTES)
      throw detail::failure("bad_reply",
                            "a header has " + std::to_string(parts[0].size()) + " bytes");
    msgpack::object_handle handle;
    try {
      const msgpack::unpack_limit limit(64, 64, detail::MAX_HEADER_BYTES, 0, 0, 32);
      handle = msgpack::unpack(parts[0].data<char>(), parts[0].size(), nullptr, nullptr, limit);
    } catch (const msgpack::unpack_error& error) {
      throw detail::failure("bad_reply", std::string("a header is not msgpack: ") + error.what());
    }
    const detail::Fields reply(handle.get());
    const auto type = reply.get<std::string>("type");
    const auto generation = reply.get<std::int64_t>("generation", 0);
    const Event about{reply.find<std::int64_t>("frame_id"), reply.find<std::int64_t>("profile_id")};
    if (type == "alive") return;
    active_ = Clock::now();
    Request* request = about.profile_id ? find(*about.profile_id) : nullptr;
    if (type == "welcome") {
      begin(reply);
    } else if (type == "result") {
      if (const auto n_views = take_in_flight(about))
        events_.push_back(detail::result_of(reply, about, *n_views, std::move(parts)));
    } else if (type == "dropped") {
      Dropped dropped{about, reply.get<std::string>("reason"), reply.get("retry_after_ms", 20.0)};
      if (take_in_flight(about)) events_.push_back(std::move(dropped));
    } else if (type == "error") {
      fail({about, reply.get<std::string>("code"), reply.get<std::string>("message", ""),
            reply.get<std::string>("field", ""), reply.get<std::string>("allowed", "")});
    } else if (type == "pong") {
      pong_ = Pong{reply.get<std::int64_t>("n_sessions"), reply.get("is_ready", true),
                   reply.get("is_degraded", false)};
    } else if (type == "accepted") {
      const bool is_building = reply.get("is_building", true);
      Accepted accepted{about, generation, is_building, reply.get("n_cameras", 1)};
      if (request) request->n_missing = std::max(1, accepted.n_cameras);
      keep(std::move(accepted));
    } else if (type == "progress") {
      keep(Progress{about, reply.get<std::string>("stage"), reply.get<double>("fraction")});
    } else if (type == "ready") {
      ++n_ready_;
      if (request && request->n_missing > 0 && --request->n_missing == 0) request->previous.reset();
      keep(Ready{about, generation, reply.get<std::vector<std::string>>("notes", {})});
    }
  }

  void begin(const detail::Fields& reply) {  // a session starts or continues
    const detail::Fields limits(reply.get<msgpack::object>("limits"));
    const detail::Fields server(reply.get<msgpack::object>("server"));
    welcome_ = Welcome{reply.get<std::int64_t>("session_id"),
                       server.get<std::string>("renderer", ""),
                       limits.get<std::int64_t>("max_part_bytes"),
                       std::max(1, reply.get<int>("credit")), reply.get("is_resumed", false)};
    max_part_bytes_ = welcome_->max_part_bytes;
    session_key_ = reply.get<std::string>("session_key", "");
    refusal_.reset();
    lose_frames(reply.get<std::uint32_t>("n_unanswered", 0));
    const auto known = reply.get<std::map<std::string, std::int64_t>>("profile_ids", {});
    for (auto& [eye, request] : requests_)
      if (const auto one = known.find(eye); one == known.end() || one->second != request.id)
        request.is_sent = false;
  }

  // Remove a frame from those in flight, unless it was reported as lost before; return its number
  // of views.
  std::optional<std::size_t> take_in_flight(const Event& about) {
    const auto found = in_flight_.find(about.frame_id.value_or(-1));
    if (found == in_flight_.end()) return {};
    const std::size_t n_views = found->second;
    in_flight_.erase(found);
    return n_views;
  }

  void fail(const Error& error) {
    Request* request = error.profile_id ? find(*error.profile_id) : nullptr;
    if (error.code == "no_session") {
      if (take_in_flight(error)) drop(*error.frame_id, "connection_lost");
      if (welcome_) greet();
    } else if (error.frame_id) {
      if (take_in_flight(error)) events_.push_back(error);
    } else if (!welcome_ || error.code == "not_allowed" || error.code == "version_mismatch") {
      refusal_ = error;
    } else if (request && error.code == "worker_crashed" && !request->has_crashed) {
      request->has_crashed = true;  // send it once more: the profile itself may be the reason
      request->is_sent = false;
    } else {
      if (request && request->previous) *request = Request(*request->previous);
      else if (request) request->n_missing = 0;
      keep(error);
    }
  }

  Request* find(std::int64_t id) {
    for (auto& [eye, request] : requests_)
      if (request.id == id) return &request;
    return nullptr;
  }

  void keep(AnyEvent event) {  // for `poll`; without it, the oldest are forgotten
    events_.push_back(std::move(event));
    if (events_.size() > MAX_EVENTS) events_.pop_front();
  }

  std::string endpoint_;
  Options options_;
  zmq::context_t context_;
  zmq::socket_t socket_{context_, zmq::socket_type::dealer};
  zmq::socket_t monitor_{context_, zmq::socket_type::pair};
  bool is_up_ = false;
  int n_broken_handshakes_ = 0;
  int n_ready_ = 0;
  Clock::time_point active_ = Clock::now();  // of the last message sent or received
  std::string session_key_;
  std::int64_t max_part_bytes_ = 100'000'000;  // until the service tells its own
  std::optional<Welcome> welcome_;
  std::optional<Error> refusal_;
  std::optional<Pong> pong_;
  std::map<std::string, Request> requests_;  // of each eye, the newest
  std::optional<Outgoing> pending_;
  std::map<std::int64_t, std::size_t> in_flight_;  // frame_id and number of views
  std::deque<Message> outbox_;
  std::deque<AnyEvent> events_;
  std::int64_t next_frame_id_ = 0;
  std::int64_t next_profile_id_ = 0;
};

}  // namespace ocufilter
