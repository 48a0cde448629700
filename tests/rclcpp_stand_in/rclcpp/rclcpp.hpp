// What examples/cpp uses of rclcpp, which the ROS 2 wheels lack, on their rmw: topics are real, futures never end, no
// warning is throttled. Their rcl needs Python.
#pragma once

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <functional>
#include <future>
#include <memory>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

#include "rcutils/strdup.h"
#include "rmw/error_handling.h"
#include "rmw/qos_profiles.h"
#include "rmw/rmw.h"
#include "rosidl_typesupport_cpp/message_type_support.hpp"

#define RCLCPP_INFO(logger, ...) ((void)(logger), std::fprintf(stderr, __VA_ARGS__), std::fputc('\n', stderr))
#define RCLCPP_WARN_THROTTLE(logger, clock, milliseconds, ...) ((void)(clock), RCLCPP_INFO(logger, __VA_ARGS__))
#define RCLCPP_ERROR RCLCPP_INFO

namespace rclcpp
{
inline rmw_context_t context = rmw_get_zero_initialized_context();
inline std::vector<std::string> arguments;

template<typename Result>
Result check(Result result)
{
  if (rmw_error_is_set()) {
    throw std::runtime_error(rmw_get_error_string().str);
  }
  return result;
}
inline void init(int argc, char const * const * argv)
{
  arguments.assign(argv, argv + argc);
  const rcutils_allocator_t allocator = rcutils_get_default_allocator();
  const char * domain = std::getenv("ROS_DOMAIN_ID");
  rmw_init_options_t options = rmw_get_zero_initialized_init_options();
  check(rmw_init_options_init(&options, allocator));
  options.enclave = rcutils_strdup("/", allocator);
  options.domain_id = domain ? std::stoul(domain) : 0;
  options.discovery_options.automatic_discovery_range = RMW_AUTOMATIC_DISCOVERY_RANGE_LOCALHOST;
  check(rmw_init(&options, &context));
}
inline std::vector<std::string> init_and_remove_ros_arguments(int argc, char const * const * argv)
{
  init(argc, argv);
  return {arguments.begin(), std::find(arguments.begin(), arguments.end(), "--ros-args")};
}
inline bool shutdown() {return rmw_shutdown(&context) == RMW_RET_OK;}

struct Logger {};
inline Logger get_logger(const std::string &) {return {};}
struct Clock {};
struct QoS
{
  explicit QoS(size_t depth) {profile.depth = depth;}
  rmw_qos_profile_t profile = rmw_qos_profile_default;
};
struct SensorDataQoS : QoS
{
  SensorDataQoS() : QoS(0) {profile = rmw_qos_profile_sensor_data;}
};
template<typename Message>
struct Publisher
{
  using SharedPtr = std::shared_ptr<Publisher>;
  void publish(const Message & message) {check(rmw_publish(handle, &message, nullptr));}
  rmw_publisher_t * handle;
};
template<typename Message>
struct Subscription
{
  using SharedPtr = std::shared_ptr<Subscription>;
};

class Node
{
public:
  explicit Node(const std::string & name)
  : handle_(check(rmw_create_node(&context, name.c_str(), "/"))) {}
  Node(const Node &) = delete;
  ~Node()  // else its threads outlive what Fast DDS tears down after main()
  {
    if (rmw_destroy_node(handle_) != RMW_RET_OK) {
      std::fprintf(stderr, "the node cannot be destroyed: %s\n", rmw_get_error_string().str);
    }
  }
  Logger get_logger() const {return {};}
  std::shared_ptr<Clock> get_clock() const {return std::make_shared<Clock>();}
  double declare_parameter(const std::string & name, double value) const
  {
    for (const std::string & argument : arguments) {
      if (argument.rfind(name + ":=", 0) == 0) {
        value = std::stod(argument.substr(name.size() + 2));
      }
    }
    return value;
  }
  template<typename Message>
  std::shared_ptr<Publisher<Message>> create_publisher(const std::string & topic, const QoS & qos)
  {
    const auto type = rosidl_typesupport_cpp::get_message_type_support_handle<Message>();
    const auto options = rmw_get_default_publisher_options();
    auto made = std::make_shared<Publisher<Message>>();
    made->handle = check(rmw_create_publisher(handle_, type, ("/" + topic).c_str(), &qos.profile, &options));
    return made;
  }
  template<typename Message>
  std::shared_ptr<Subscription<Message>> create_subscription(
    const std::string & topic, const QoS & qos, std::function<void(const Message &)> callback)
  {
    const auto type = rosidl_typesupport_cpp::get_message_type_support_handle<Message>();
    const auto options = rmw_get_default_subscription_options();
    const auto handle = check(rmw_create_subscription(handle_, type, ("/" + topic).c_str(), &qos.profile, &options));
    take_.push_back(
      [handle, callback]() {
        Message message;
        bool taken = false;
        check(rmw_take(handle, &message, &taken, nullptr));
        if (taken) {
          callback(message);
        }
      });
    return std::make_shared<Subscription<Message>>();
  }
  [[noreturn]] void spin()
  {
    while (true) {
      for (const auto & take : take_) {
        take();
      }
      std::this_thread::sleep_for(std::chrono::milliseconds(5));
    }
  }

private:
  rmw_node_t * const handle_;
  std::vector<std::function<void()>> take_;
};
inline void spin(std::shared_ptr<Node> node) {node->spin();}

enum class FutureReturnCode { SUCCESS, INTERRUPTED, TIMEOUT };
template<typename Future>
FutureReturnCode spin_until_future_complete(std::shared_ptr<Node>, const Future &, std::chrono::seconds)
{
  return FutureReturnCode::TIMEOUT;
}
}  // namespace rclcpp
